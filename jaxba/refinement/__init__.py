"""What follows the linear solve: accept decision, point and camera refinement, backtracking,
pattern moves."""
