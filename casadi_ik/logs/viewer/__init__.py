"""A solve for Foxglove and Lichtblick."""
