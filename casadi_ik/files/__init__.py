"""Description files: YAML with units, and where the shipped ones are."""
