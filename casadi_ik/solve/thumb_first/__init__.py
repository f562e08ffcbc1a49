"""The arm starts at the estimated palm, then the closed chain of arm and thumb (ours)."""
