"""The game of bundle adjustment: a vectorised environment over the LM step, its scenes, and the
scores of policies."""
