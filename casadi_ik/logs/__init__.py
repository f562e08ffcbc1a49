"""MCAP logs: records, writer, reader, events."""
