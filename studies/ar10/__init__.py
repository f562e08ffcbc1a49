"""What the studies of the AR10 share."""
