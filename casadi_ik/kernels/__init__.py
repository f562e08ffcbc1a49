"""Kernels: a CasADi Function becomes a fast callable."""
