"""Proofs that targets are impossible: the search for them, and a check by other means."""
