"""Qiu & Kermani 2021: thumb first, then the closed chain of arm and thumb, and its baselines."""
