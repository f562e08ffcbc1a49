"""The bytes of a message of fixed size: MCAP Message record, CDR header, row."""

from __future__ import annotations

import numpy as np
from mcap.opcode import Opcode

from casadi_ik.kernels.rows import opaque

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
        buffer: As many bytes as they have, overwritten.
        channel: Channel id.
        rows: (k,) packed.
        sequence: (k,).
        log_time: (k,) [ns].
        publish_time: (k,) [ns].
    """
    head = np.zeros(1, HEAD)
    size = HEAD.itemsize + rows.dtype.itemsize
    head["prefix"]["opcode"] = Opcode.MESSAGE
    head["prefix"]["length"] = size - RECORD_HEAD
    head["prefix"]["channel"] = channel
    head["cdr"] = CDR_NUMBER
    payload = opaque(rows)
    messages = buffer.view([("head", opaque(head).dtype), ("row", payload.dtype)])
    messages["head"] = opaque(head)
    messages["row"] = payload
    prefix = buffer.view([("prefix", PREFIX), ("rest", np.void, size - PREFIX.itemsize)])["prefix"]
    prefix["sequence"] = sequence
    prefix["log_time"] = log_time
    prefix["publish_time"] = publish_time
