"""The bytes of a message of fixed size: MCAP Message record, CDR header, row."""

from __future__ import annotations

from typing import Any

import numpy as np
from mcap.opcode import Opcode

CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of little-endian plain CDR."""

RECORD_HEAD = 9
"""Bytes of a record's opcode and length."""

PREFIX = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""A Message record up to its payload."""

HEAD = np.dtype([("prefix", PREFIX), ("cdr", "<u4")])
"""A Message record up to its row."""

CDR_NUMBER = int.from_bytes(CDR_HEADER, "little")


def message_dtype(row: np.dtype[Any]) -> np.dtype[Any]:
    """A whole message around a row: fields "prefix", "cdr", "row"."""
    return np.dtype([("prefix", PREFIX), ("cdr", "<u4"), ("row", row)])


def fill(
    buffer: np.ndarray,
    channel: int,
    rows: np.ndarray,
    sequence: np.ndarray,
    log_time: np.ndarray,
    publish_time: np.ndarray,
) -> None:
    """Write messages.

    Args:
        buffer: Bytes (k, message size), overwritten.
        channel: Channel id.
        rows: (k,) packed.
        sequence: (k,).
        log_time: (k,) [ns].
        publish_time: (k,) [ns].
    """
    # As bytes, since numpy copies a structured row field by field.
    buffer[:, HEAD.itemsize :] = octets_of(rows)
    head = np.empty(len(buffer), HEAD)
    prefix = head["prefix"]
    prefix["opcode"] = Opcode.MESSAGE
    prefix["length"] = buffer.shape[1] - RECORD_HEAD
    prefix["channel"] = channel
    prefix["sequence"] = sequence
    prefix["log_time"] = log_time
    prefix["publish_time"] = publish_time
    head["cdr"] = CDR_NUMBER
    buffer[:, : HEAD.itemsize] = octets_of(head)


def octets_of(rows: np.ndarray) -> np.ndarray:
    """Rows (k,) as bytes (k, row size)."""
    return np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), rows.dtype.itemsize)
