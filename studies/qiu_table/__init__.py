"""Qiu & Kermani 2021, Table I: the paper's figures, ours, and what the paper leaves open."""
