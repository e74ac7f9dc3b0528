"""The bundle adjustment problem: cameras, points, observations, losses and what may be changed before a solve."""
