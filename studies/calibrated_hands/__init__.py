"""Hands that are calibrated although their dimensions are known: trials and their pictures."""
