"""Loops, phases, status and verdicts."""
