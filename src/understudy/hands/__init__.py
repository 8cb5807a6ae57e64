"""Which way palms face."""
