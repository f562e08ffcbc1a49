"""Shapes of links from published meshes, for `fit_shapes.py`."""
