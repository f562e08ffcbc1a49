"""Batches in parts, here or on a cluster: targets from files, answers into files."""
