"""Torn logs made whole, shards joined."""
