"""A complete solve: preparation, choice of the linear solver, the loop, solver names."""
