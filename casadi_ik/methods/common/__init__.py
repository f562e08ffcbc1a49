"""What several methods work with."""
