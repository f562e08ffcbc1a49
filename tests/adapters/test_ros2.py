"""Contacts to joint states between two processes, where eclipse-zenoh is installed."""

from __future__ import annotations

import queue
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

import casadi_ik as ik

zenoh = pytest.importorskip("zenoh")

from casadi_ik.integrations.ros2 import decode_contacts, encode_contacts  # noqa: E402

ROBOT = "panda+allegro_right"

NODE = """
import sys, zenoh, casadi_ik as ik
from casadi_ik.integrations.ros2 import ContactNode
config = zenoh.Config()
config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:%s"]' % sys.argv[1])
config.insert_json5("scouting/multicast/enabled", "false")
with ContactNode(ik.Solver(ik.load_robot(sys.argv[2])), config=config) as node:
    print("ready", flush=True)
    sys.stdin.read()
    print(node.refused, flush=True)
"""


@pytest.fixture
def node() -> Iterator[int]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", NODE, str(port), ROBOT]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield port
        assert "PoseArray" in process.communicate()[0]  # what was refused


def test_contacts_round_trip_as_bytes(rng):
    points, normals = rng.normal(size=(2, 5, 3))
    normals[0] = -1, 0, 0
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points[1], normals[2] = np.nan, np.nan
    decoded = decode_contacts(encode_contacts(points, normals))
    np.testing.assert_allclose(decoded[0], points)
    np.testing.assert_allclose(decoded[1], normals, atol=1e-12)


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 60])
def test_malformed_bytes_are_refused(data):
    with pytest.raises(ik.errors.InputError, match="PoseArray"):
        decode_contacts(data)


def test_messages_match_ros_serialisation(rng):
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    points, normals = rng.normal(size=(2, 4, 3))
    data = encode_contacts(points, normals, "panda_base")
    message = store.deserialize_cdr(data, "geometry_msgs/msg/PoseArray")
    assert message.header.frame_id == "panda_base"
    np.testing.assert_allclose(
        [[p.position.x, p.position.y, p.position.z] for p in message.poses], points
    )
    data_again = bytes(store.serialize_cdr(message, "geometry_msgs/msg/PoseArray"))
    assert data_again == data


@pytest.mark.slow
def test_service_answers_another_process(node, rng):
    """Print the median of the round trips (`pytest -s`), which includes decoding the answer."""
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{node}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    robot, answers = ik.load_robot(ROBOT), queue.SimpleQueue()
    types = pytest.importorskip("rosbags.typesys")
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(
            "joint_commands", lambda x: answers.put(bytes(x.payload))
        )
        publisher = session.declare_publisher("contacts")
        time.sleep(0.5)
        times = []
        for q in robot.random(rng, 100):
            points, normals = robot.contacts(q)
            begin = time.perf_counter()
            publisher.put(encode_contacts(points, normals))
            message = store.deserialize_cdr(answers.get(timeout=180), "sensor_msgs/msg/JointState")
            times.append(time.perf_counter() - begin)
            assert message.name == list(robot.actuators)
            points_reached, _ = robot.contacts(np.array(message.position))
            assert np.linalg.norm(points_reached - points, axis=1).max() < 5e-3
        sys.stdout.write(f"median round trip {1e3 * np.median(times):.2f} ms\n")
        publisher.put(b"nonsense")
        subscriber.undeclare()
        time.sleep(0.5)
