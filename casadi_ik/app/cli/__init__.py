"""Command line: `main` selects a command, which returns a `CommandResult` that `main` prints.

Parsing a command line imports only `table` and `options`; modules that solve, draw or read logs are
imported by the command that needs them.
"""
