"""A viewer file as libraries other than ours read it, and drawn from nothing but that."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio
import pyvista as pv
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2


@dataclass(frozen=True)
class Decoded:
    """Messages by topic, each with its log time [ns]."""

    topics: dict[str, list[tuple[int, Any]]]
    schemas: dict[str, str]

    def last(self, topic: str) -> Any:
        return self.topics[topic][-1][1]

    def frames(self, row: int) -> dict[str, np.ndarray]:
        """Pose of every frame in the root's, from the transforms of one message."""
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
    """(4, 4) pose of a message's position and orientation."""
    found = np.eye(4)
    found[:3, :3] = pinocchio.Quaternion(q.w, q.x, q.y, q.z).matrix()
    found[:3, 3] = position.x, position.y, position.z
    return found


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


def draw(decoded: Decoded, row: int, picture: Path) -> None:
    """The URDF's cylinders at the transforms, and the arrows of the contacts."""
    plotter = pv.Plotter(off_screen=True, window_size=[900, 700])
    frames = decoded.frames(row)
    for link in ElementTree.fromstring(decoded.last("/robot_description").data).iter("link"):
        for visual in link.iter("visual"):
            origin, cylinder = visual.find("origin"), visual.find("geometry/cylinder")
            assert origin is not None
            assert cylinder is not None
            roll, pitch, yaw = map(float, origin.attrib["rpy"].split())
            pose = np.eye(4)
            pose[:3, :3] = pinocchio.rpy.rpyToMatrix(roll, pitch, yaw)
            pose[:3, 3] = list(map(float, origin.attrib["xyz"].split()))
            solid = pv.Cylinder(
                direction=(0, 0, 1),
                radius=float(cylinder.attrib["radius"]),
                height=float(cylinder.attrib["length"]),
            )
            rgba = visual.find("material/color")
            assert rgba is not None
            color = list(map(float, rgba.attrib["rgba"].split()[:3]))
            plotter.add_mesh(
                solid.transform(frames[link.attrib["name"]] @ pose, inplace=False), color=color
            )
    for topic, index in (("/ik/targets", 0), ("/ik/contacts", row)):
        for entity in decoded.topics[topic][index][1].entities:
            for arrow in entity.arrows:
                pose = matrix(arrow.pose.position, arrow.pose.orientation)
                length = arrow.shaft_length + arrow.head_length
                solid = pv.Arrow(
                    start=pose[:3, 3],
                    direction=pose[:3, 0],
                    scale=length,
                    shaft_radius=arrow.shaft_diameter / 2 / length,
                    tip_radius=arrow.head_diameter / 2 / length,
                )
                color = [arrow.color.r, arrow.color.g, arrow.color.b]
                plotter.add_mesh(
                    solid.transform(frames[entity.frame_id], inplace=False), color=color
                )
    plotter.camera_position = "iso"
    plotter.screenshot(str(picture))
    plotter.close()
