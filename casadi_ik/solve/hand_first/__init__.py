"""Palm and hand are fitted to the contacts, the arm follows (ours, the default)."""
