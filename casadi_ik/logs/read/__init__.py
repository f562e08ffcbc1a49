"""Logs read back."""
