"""Other ways to make a step than plain Levenberg-Marquardt, reached through `registry`."""
