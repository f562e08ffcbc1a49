"""Certified reachability: maps of palm poses, and the placement of the base."""
