"""What happens in an iteration that is worth a line of its own."""
