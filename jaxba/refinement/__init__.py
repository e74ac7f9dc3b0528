"""Around a step: points and cameras re-optimised alone, backtracking, pattern moves, acceptance."""
