"""What the study of collisions is made of."""
