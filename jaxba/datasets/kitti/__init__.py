"""From the images of a KITTI odometry sequence to a bundle adjustment problem, and trajectories compared.

Key-points, tracks and starts need the extra `kitti` (OpenCV); trajectories and plots do not.
"""
