"""Command-line programs. Modules import JAX and other slow packages only after the arguments have been checked."""
