"""Static index arrays that turn the sparse sums of a problem into dense ones."""
