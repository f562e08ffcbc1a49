"""What the studies of the arm-thumb closed chain share."""
