"""Everything that is about XLA or the operating system, and nothing else."""
