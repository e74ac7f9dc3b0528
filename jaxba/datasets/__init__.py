"""Published data sets: BAL problems by name, KITTI images to a problem."""
