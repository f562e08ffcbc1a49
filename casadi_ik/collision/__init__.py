"""Shapes, scenes and distances: what may be hit, and how far it is."""
