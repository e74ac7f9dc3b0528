"""Published data sets: BAL problems by name."""
