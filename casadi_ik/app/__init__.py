"""Command line, browser viewer, pictures and reports."""
