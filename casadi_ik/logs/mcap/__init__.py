"""The MCAP format: records, files, chunks, messages."""
