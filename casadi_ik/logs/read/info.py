"""What is in a log, without its messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class LogInfo:
    """What is in a log, without reading its messages.

    Attributes:
        paths: The files.
        size: Their size [bytes].
        robot: Name of the robot.
        counts: Messages by method and kind: {"enhanced-dls": {"iteration": 120, ...}}.
        compression: Of the chunks.
        chunks: How many chunks there are.
        uncompressed: Size of the chunks' contents [bytes].
        compressed: Size of the chunks as stored [bytes].
        metadata: Where the log comes from (seed, versions, parameters, ...), of the first file.
        attachments: Attached files and their sizes [bytes], of the first file.
        unfinished: Files without a footer: their writer was killed or is still at it. What is
            after their last complete chunk is lost.
        left_out: Files in which nothing is whole: their writer was killed before its first chunk.
        differs: Entries of the metadata in which the shards differ, and what they say.

    Example:
        >>> info = ik.logs.open("cup.mcap").info()
        >>> info.robot, info.counts["hand-first"]["solve"]
        ('kuka_lwr_barrett', 1)
    """

    paths: tuple[Path, ...]
    size: int
    robot: str
    counts: Mapping[str, Mapping[str, int]]
    compression: str
    chunks: int
    uncompressed: int
    compressed: int
    metadata: Mapping[str, Any]
    attachments: Mapping[str, int]
    unfinished: tuple[Path, ...]
    left_out: tuple[Path, ...] = ()
    differs: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
