"""What the study of moving targets is made of."""
