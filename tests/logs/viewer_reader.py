"""Viewer files as decoded by other libraries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2

from casadi_ik.app.log_viewers import layout_of, shipped_layout, write_view

__all__ = ["Decoded", "decode", "layout_of", "shipped_layout", "write_view"]


@dataclass(frozen=True)
class Decoded:
    """Decoded messages by topic, each with its log time [ns]."""

    topics: dict[str, list[tuple[int, Any]]]
    schemas: dict[str, str]

    def last(self, topic: str) -> Any:
        return self.topics[topic][-1][1]

    def frames(self, row: int) -> dict[str, np.ndarray]:
        """Return the pose of every frame in the root frame, from the transforms of one message."""
        message = self.topics["/tf"][row][1]
        parents = {t.child_frame_id: t for t in message.transforms}
        root = next(
            t.parent_frame_id for t in message.transforms if t.parent_frame_id not in parents
        )
        poses = {root: np.eye(4)}

        def pose(name: str) -> np.ndarray:
            if name not in poses:
                t = parents[name]
                poses[name] = pose(t.parent_frame_id) @ matrix(t.translation, t.rotation)
            return poses[name]

        return {name: pose(name) for name in (root, *parents)}


def matrix(position: Any, q: Any) -> np.ndarray:
    """Return the pose (4, 4) of the position and orientation of a message."""
    pose = np.eye(4)
    pose[:3, :3] = pinocchio.Quaternion(q.w, q.x, q.y, q.z).matrix()
    pose[:3, 3] = position.x, position.y, position.z
    return pose


def decode(path: Path) -> Decoded:
    """Read a viewer file with `mcap` and its decoders for protobuf and ROS 2."""
    topics: dict[str, list[tuple[int, Any]]] = {}
    schemas: dict[str, str] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[Protobuf(), Ros2()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            topics.setdefault(channel.topic, []).append((message.log_time, decoded))
            schemas[channel.topic] = "" if schema is None else schema.name
    return Decoded(topics, schemas)
