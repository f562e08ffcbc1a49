"""Solves in words."""
