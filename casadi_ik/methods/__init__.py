"""A method is a folder."""
