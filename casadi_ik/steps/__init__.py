"""One iteration of each method, as a graph."""
