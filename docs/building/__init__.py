"""What the site is generated with: extensions of Sphinx."""
