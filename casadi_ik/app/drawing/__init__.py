"""What there is to draw, for pictures and pages alike."""
