"""From recordings of a person to trajectories of hand, torso and object, in segments."""
