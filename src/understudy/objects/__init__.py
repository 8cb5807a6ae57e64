"""The manipulated object: how it can move, and where it is."""
