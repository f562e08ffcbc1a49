"""From somebody's files to a description: what no file says is guessed, and the guess is shown."""
