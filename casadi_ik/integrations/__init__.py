"""Adapters to other systems: frameworks, robot files, data sets, clusters."""
