"""Soft actor-critic on the game, compiled as one program, and the driver around it."""
