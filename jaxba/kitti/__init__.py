"""From the images of a KITTI odometry sequence to a bundle adjustment problem, and trajectory
errors of its solutions.

Key-points, tracks and visual odometry need the extra `kitti` (OpenCV); trajectory errors do not."""
