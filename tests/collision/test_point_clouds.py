"""Point clouds near a robot act like balls at their points, for every kind of file."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from capsule_arm import write_robot
from coal_oracle import described, distance
from toy_robots import grasp_at

import casadi_ik as ik
from casadi_ik import errors

RADIUS = 0.01


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> ik.ArmHand:
    return ik.load_robot(write_robot(tmp_path_factory.mktemp("three")))


def surfaces(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return points (count, 3) of a floor, a wall and a ball, as a camera measures them."""
    flat = rng.uniform([-0.8, -0.8, -0.21], [0.8, 0.8, -0.2], (count, 3))
    wall = rng.uniform([0.55, -0.5, -0.2], [0.56, 0.5, 0.8], (count, 3))
    directions = rng.normal(size=(count, 3))
    ball = [0.3, 0.35, 0.4] + 0.1 * directions / np.linalg.norm(directions, axis=1)[:, None]
    return np.concatenate([flat[: count // 3], wall[: count // 3], ball])[:count]


def cloud(points: np.ndarray, **fields: object) -> ik.Scene:
    return ik.Scene({"seen": {"kind": "point-cloud", "points": points, "radius": RADIUS, **fields}})


def clearances(robot: ik.ArmHand, scene: ik.Scene, q: np.ndarray, **options: bool) -> np.ndarray:
    """Return the clearance of all checked pairs (k,) [m]."""
    verdicts = ik.Solver(robot, scene=scene, **options).check(q, grasp_at(robot, robot.home))
    assert verdicts is not None
    return verdicts.distance


def by_hand(robot: ik.ArmHand, points: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the least distance (k,) of the robot's capsules from balls at points [m]."""
    links, clearance = robot.links(q), np.full(len(q), np.inf)
    for capsule in robot.description.shapes.capsules:
        if capsule.link == "base":
            continue
        pose = links[capsule.link]
        middle = pose[:, :3, :3] @ capsule.center + pose[:, :3, 3]
        half_axis = pose[:, :3, :3] @ capsule.half_axis
        offsets = points - middle[:, None]
        long = max(float(capsule.half_axis @ capsule.half_axis), 1e-30)
        t = np.clip(np.einsum("kmi,ki->km", offsets, half_axis) / long, -1, 1)
        separation = np.linalg.norm(offsets - t[..., None] * half_axis[:, None], axis=2).min(axis=1)
        clearance = np.minimum(clearance, separation - capsule.radius - RADIUS)
    return clearance


def test_cloud_distances_match_numpy(robot, rng):
    points = surfaces(rng, 5000)
    q = robot.random(rng, 150)
    itself = clearances(robot, ik.Scene(), q)
    expected = np.minimum(itself, by_hand(robot, points, q))
    assert (expected < itself).sum() > 10
    np.testing.assert_allclose(clearances(robot, cloud(points), q), expected, atol=1e-9)


def test_cloud_equals_its_balls(robot, rng):
    points = surfaces(rng, 70)
    balls = {
        str(i): {"kind": "sphere", "radius": RADIUS, "xyz": point} for i, point in enumerate(points)
    }
    q = robot.random(rng, 60)
    cloud_clearance, ball_clearance = (
        clearances(robot, cloud(points), q),
        clearances(robot, ik.Scene(balls), q),
    )
    np.testing.assert_allclose(cloud_clearance, ball_clearance, atol=1e-12)
    # coal has the capsules exactly, so that its clearance is never smaller.
    import coal

    shapes = [
        cloud_clearance
        for cloud_clearance in described(robot)
        if isinstance(cloud_clearance[1], coal.Capsule)
    ]
    ball, links = coal.Sphere(RADIUS), robot.links(q)
    for row in range(0, len(q), 6):
        for link, shape, pose in shapes:
            if link == "base":
                continue
            for point in points:
                cloud_pose = np.eye(4)
                cloud_pose[:3, 3] = point
                assert (
                    cloud_clearance[row]
                    <= distance(shape, links[link][row] @ pose, ball, cloud_pose) + 1e-6
                )


def test_numpy_fallback_gives_the_same_clearance(robot, rng):
    scene = cloud(surfaces(rng, 2500), xyz=[0, 0, 0.05], rpy=[0.1, 0.2, 0.3])
    q = robot.random(rng, 40)
    compiled_clearance, numpy_clearance = (
        clearances(robot, scene, q, compiled=is_compiled) for is_compiled in (True, False)
    )
    np.testing.assert_allclose(compiled_clearance, numpy_clearance, atol=3e-7)


def test_thinned_clouds_are_conservative(robot, rng):
    points = surfaces(rng, 4000)
    q = robot.random(rng, 80)
    full, thin = (clearances(robot, cloud(points, voxel=edge), q) for edge in (0.0, 0.03))
    assert (thin <= full + 1e-12).all()
    assert (full - thin).max() < 2 * 0.03
    parts = cloud(points, voxel=0.03).items["seen"].parts
    assert sum(len(np.unique(solid.points, axis=0)) for solid, _ in parts) < 2500


def written(folder: Path, points: np.ndarray) -> list[Path]:
    """Files of all kinds with the same points."""
    rows = [" ".join(f"{value:.17g}" for value in row) for row in points]
    np.save(folder / "a.npy", points)
    np.savez(folder / "b.npz", points=points, colors=points)
    np.savez_compressed(folder / "c.npz", points)
    (folder / "d.xyz").write_text("# x y z\n" + "\n".join(rows))
    (folder / "e.csv").write_text("\n".join(row.replace(" ", ", ") + ", 255" for row in rows))
    head = "ply\nformat {}\ncomment made up\nelement vertex {}\nproperty uchar red\n"
    head += "".join(f"property double {axis}\n" for axis in "zxy")
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    permuted = points[:, [2, 0, 1]]
    lines = "\n".join("7 " + " ".join(f"{v:.17g}" for v in row) for row in permuted)
    (folder / "f.ply").write_text(head.format("ascii 1.0", len(points)) + lines + "\n")
    for name, form in (("g.ply", "<"), ("h.ply", ">")):
        word = {"<": "little", ">": "big"}[form]
        data = np.zeros(len(points), [("red", "u1"), ("p", f"{form}f8", 3)])
        data["p"] = permuted
        header = head.format(f"binary_{word}_endian 1.0", len(points))
        (folder / name).write_bytes(header.encode() + data.tobytes())
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z normal rgb\nSIZE 8 8 8 4 4\nTYPE F F F F U\n"
    head += f"COUNT 1 1 1 2 1\nWIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA "
    (folder / "i.pcd").write_text(head + "ascii\n" + "\n".join(f"{row} 0 0 9" for row in rows))
    data = np.zeros(len(points), [("p", "<f8", 3), ("n", "<f4", 2), ("c", "<u4")])
    data["p"] = points
    (folder / "j.pcd").write_bytes(head.encode() + b"binary\n" + data.tobytes())
    (folder / "k.csv").write_text(
        "id,x,y,z,label\n" + "\n".join(f"7,{row.replace(' ', ',')},8" for row in rows)
    )
    (folder / "l.xyz").write_text(f"{len(points)}\n" + "\n".join(rows))
    (folder / "m.txt").write_text("//X Y Z R\n" + "\n".join(f"{row} 255" for row in rows))
    (folder / "n.csv").write_text(
        "\ufeff" + "a;b;c\n" + "\n".join(r.replace(" ", ";") for r in rows)
    )
    image = np.concatenate([points, np.full((-len(points) % 4, 3), np.nan)]).reshape(4, -1, 3)
    np.save(folder / "o.npy", image)
    np.savez(folder / "p.npz", points=np.concatenate([image, image], axis=2))
    np.save(folder / "q.npy", np.hstack([points, points]))
    named = np.zeros(len(points), [("rgb", "f4"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    for axis, column in zip("xyz", points.T, strict=True):
        named[axis] = column
    np.save(folder / "r.npy", named)
    columns = [points[:, 0], points[:, 1], points[:, 2], np.zeros((len(points), 2), "<f4")]
    raw = b"".join(column.tobytes() for column in columns) + bytes(4 * len(points))
    packed = pack_lzf(raw)
    assert len(packed) < len(raw)
    sizes = struct.pack("<II", len(packed), len(raw))
    (folder / "s.pcd").write_bytes(head.encode() + b"binary_compressed\n" + sizes + packed)
    return sorted(folder.iterdir())


def pack_lzf(data: bytes) -> bytes:
    """Compress by the LZF format: literals of at most 32 bytes, and references to earlier bytes."""
    packed, literals, positions, place = bytearray(), bytearray(), dict[bytes, int](), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            part = literals[start : start + 32]
            packed.append(len(part) - 1)
            packed.extend(part)
        literals.clear()

    while place < len(data):
        key = data[place : place + 3]
        start, length = positions.get(key, -1), 0
        positions[key] = place
        if len(key) == 3 and start >= 0 and place - start <= 8192:
            match_limit = min(264, len(data) - place)
            while length < match_limit and data[start + length] == data[place + length]:
                length += 1
        if length < 3:
            literals.append(data[place])
            place += 1
            continue
        flush()
        back = place - start - 1
        short = min(length - 2, 7)
        packed.append((short << 5) | (back >> 8))
        if short == 7:
            packed.append(length - 2 - 7)
        packed.append(back & 255)
        place += length
    flush()
    return bytes(packed)


def test_file_formats_give_the_same_points(robot, rng, tmp_path):
    points = surfaces(rng, 100)
    holed = np.insert(points, 3, np.nan, axis=0)  # as cameras write what they do not see
    q = robot.random(rng, 20)
    expected = clearances(robot, cloud(points), q)
    np.testing.assert_array_equal(clearances(robot, cloud(holed), q), expected)
    (tmp_path / "files").mkdir()
    files = written(tmp_path / "files", holed)
    assert len(files) == 19
    for file in files:
        path = tmp_path / "scene.yaml"
        path.write_text(
            f"solids: {{seen: {{kind: point-cloud, file: files/{file.name}, radius: 10 mm}}}}\n"
        )
        values = clearances(robot, ik.load_scene(path), q)
        np.testing.assert_allclose(values, expected, atol=1e-12, err_msg=file.name)


HEAD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 9\n"
PACKED = HEAD + b"DATA binary_compressed\n"


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.npy", b"", "cannot be read"),
        ("a.npy", b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, ", "cannot be"),
        ("a.ply", b"solid", "is not a PLY file"),
        ("a.ply", b"ply\nelement vertex 9\nproperty float x\nend_header\n", "x, y"),
        ("a.ply", b"ply\nformat what 1.0\n", "cannot be read"),
        ("a.ply", b"ply\nelement vertex 99999999999\nend_header\n", "at most 10000000"),
        ("a.pcd", b"VERSION 0.7\nDATA ascii\n", "cannot be read"),
        ("a.pcd", HEAD + b"DATA binary_compressed\n", "cannot be read"),
        ("a.pcd", PACKED + struct.pack("<II", 2, 9) + b"ab", "9 bytes"),
        ("a.pcd", PACKED + struct.pack("<II", 3, 108) + b"\xe0", "end"),
        ("a.pcd", PACKED + struct.pack("<II", 3, 108) + b" \x05a", "dam"),
        ("a.pcd", HEAD + b"DATA zipped\n", "found zipped"),
        ("a.pcd", HEAD + b"DATA binary\nabc", "after 0 of 9"),
        ("a.pcd", HEAD + b"TYPE Q F F\nDATA binary\n", "cannot be"),
        ("a.xyz", b"1 2\n3 4\n", "cannot be read"),
        ("a.xyz", b"", "found no points"),
        ("a.xyz", b"nan nan nan\n", "found no points"),
        ("a.npz", b"PK", "not an npz file"),
        ("a.las", b"", "expected a name that ends in .npy, .npz, .ply, .pcd, .xyz, .txt, .csv"),
    ],
)  # fmt: skip
def test_malformed_cloud_files_are_refused(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    entry = {"kind": "point-cloud", "radius": 0.01, "file": str(tmp_path / name)}
    with pytest.raises(errors.DescriptionError, match=message) as caught:
        ik.Scene({"seen": entry})
    assert "\n" not in str(caught.value)
    assert "solids.seen" in str(caught.value)


def test_bad_cloud_arrays_and_keys_are_refused(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("points.npy", "w", force_zip64=True) as stream,
    ):
        np.lib.format.write_array(stream, np.zeros((11_000_000, 3)))
    points = np.zeros((2, 3))
    for extra, message in (
        ({"points": np.zeros((2, 2))}, r"points.* \(2, 2\)"),
        ({"points": np.full((2, 3), "a")}, "expected numbers"),
        ({"points": np.full((2, 3), np.nan)}, "found no points"),
        ({}, "points"),
        ({"points": points, "file": "a.npy"}, "points"),
        ({"points": points, "voxel": -1}, "voxel: found -1, expected >= 0"),
        ({"points": points, "radius": 0}, "radius: found 0, expected > 0"),
        ({"file": str(tmp_path / "no.npy")}, "no such file"),
        ({"file": str(tmp_path / "bomb.npz")}, "unpacks to 264000[0-9]* bytes; ex"),
        ({"points": np.random.default_rng(0).normal(size=(100_001, 3))}, "found 100001 points"),
    ):
        with pytest.raises(errors.DescriptionError, match=message) as caught:
            ik.Scene({"seen": {"kind": "point-cloud", "radius": 0.01, **extra}})
        assert str(caught.value).startswith("scene: solids.seen")


def test_solutions_keep_clear_of_a_cloud(rng):
    """In a scene with only a cloud, the answer is free, or the cloud is the obstacle."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    bare = ik.Solver(robot, scene=ik.Scene()).solve(grasp)
    assert bare.success
    # Points around the elbow of the answer of the free scene.
    elbow = robot.links(bare.q)["lwr_link_4"][:3, 3]
    scene = cloud(elbow + rng.uniform(-0.05, 0.05, (2000, 3)))
    solver = ik.Solver(robot, scene=scene)
    verdict = solver.check(bare.q, grasp)
    assert verdict is not None
    assert verdict.distance.min() < 0
    solution = solver.solve(grasp)
    assert solution.success
    assert solution.clearance is not None
    assert solution.clearance >= -1e-9
    tips = np.array([contact.point for contact in grasp.contacts.values()])
    closed = cloud(tips.mean(axis=0) + rng.uniform(-0.3, 0.3, (2000, 3)))
    blocked = ik.Solver(robot, scene=closed).solve(grasp)
    assert blocked.status is ik.Status.COLLISION
    assert blocked.closest is not None
    assert "seen" in blocked.closest


def test_pose_formats_are_equivalent(robot, rng, tmp_path):
    rpy = [0.4, -0.3, 1.1]
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a / 2), np.sin(a / 2)) for a in rpy)
    w = cr * cp * cy + sr * sp * sy
    x, y, z = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    box = {"kind": "box", "size": [0.3, 0.1, 0.2]}
    xyz, q = [0.4, 0.1, 0.3], robot.random(rng, 40)
    first = ik.Scene({"a": {**box, "xyz": xyz, "rpy": rpy}})
    expected = clearances(robot, first, q)
    pose = first.items["a"].pose
    for pose_keys in (
        {"xyz": xyz, "quaternion_wxyz": [w, x, y, z]},
        {"xyz": xyz, "quaternion_xyzw": np.round([-x, -y, -z, -w], 4)},
        {"pose": pose},
        {"pose": pose.tolist()},
    ):
        values = clearances(robot, ik.Scene({"a": {**box, **pose_keys}}), q)
        np.testing.assert_allclose(values, expected, atol=1e-4)
    path = tmp_path / "scene.yaml"
    path.write_text(
        "solids:\n  a:\n    kind: box\n    size: [300 mm, 100 mm, 200 mm]\n    pose:\n"
        + "".join(f"      - {row}\n" for row in pose.tolist())
    )
    np.testing.assert_allclose(clearances(robot, ik.load_scene(path), q), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("pose_keys", "message"),
    [
        ({"rpy": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}, "found rpy and quaternion_wxyz, ex"),
        ({"pose": np.eye(4), "xyz": [0, 0, 0]}, "found pose and xyz, expected one of them"),
        ({"quaternion_wxyz": [0, 0, 0, 0]}, "quaternion_wxyz: found length 0, expected 1"),
        ({"quaternion_xyzw": [1, 1, 0, 0]}, "quaternion_xyzw: found length 1.41421, expected 1"),
        ({"quaternion_wxyz": [1, 0, 0]}, "quaternion_wxyz: expected `array` of length 4, got 3"),
        ({"pose": 2 * np.eye(4)}, "pose: the matrix is not a rotation"),
        ({"pose": np.eye(3)}, "pose"),
    ],
)
def test_malformed_poses_are_refused(pose_keys, message):
    with pytest.raises(errors.DescriptionError, match=message) as caught:
        ik.Scene({"a": {"kind": "box", "size": [1, 1, 1], **pose_keys}})
    assert str(caught.value).startswith("scene: solids.a")
