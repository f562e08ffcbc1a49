"""Batches, streams and single steps of any method."""
