"""The camera model: residuals, cost and Jacobians of all observations."""
