"""Solvers as source code of their own: plain C, and WebAssembly for a page."""
