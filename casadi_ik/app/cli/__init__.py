"""The command line: `main` picks a command, a command gives an `Answer`, `main` shows it.

Only `parser` and `values` are imported to understand a command line; what solves, draws or logs
comes in with the command that needs it.
"""
