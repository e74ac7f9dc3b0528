"""Index arrays of a problem: layout, summation trees, pairs of observations, clusters, padding."""
