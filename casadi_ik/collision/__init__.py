"""Collision shapes, scenes, distances and clearance."""
