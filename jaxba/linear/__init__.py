"""The damped linear system: Schur complement, factorisations, conjugate gradients,
preconditioners."""
