"""Solves on their way into a log."""
