"""What a solver answers: solutions, diagnoses, rankings, and what is recorded of solves."""
