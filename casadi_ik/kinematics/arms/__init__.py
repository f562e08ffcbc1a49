"""Arms whose joints follow from a palm pose: families, which of them an arm is, and its search."""
