"""The game of bundle adjustment: a vectorised environment over the LM step, and agents that learn to play it."""
