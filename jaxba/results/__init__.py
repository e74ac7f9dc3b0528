"""What follows a solve: covariance, derivatives, retriangulation and its alternation with
solves."""
