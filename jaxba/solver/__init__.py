"""A whole solve: the loop, the choice of the linear solver, retriangulation, solver names."""
