"""Optimisation methods besides plain Levenberg-Marquardt, by name in `registry`."""
