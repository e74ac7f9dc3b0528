"""What is constant or measured besides the pixels, from a file or a mapping, and a survey's
report."""
