"""The bundle adjustment problem: cameras, points, observations, losses, options and
preprocessing."""
