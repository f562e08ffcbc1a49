"""Import of a robot from URDF or MJCF files: choices, guesses and the resulting description."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, InputError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.fingers import (
    FingerChain,
    find_fingers,
    guess_fixed_jaw,
    guess_pads,
    guess_palm_frame,
    guess_thumb,
    tool_pad,
)
from casadi_ik.integrations.importing.limbs import (
    MIN_LONE_ARM_JOINTS,
    LinkChoice,
    choose_palms,
    choose_tip,
    is_wheel,
)
from casadi_ik.integrations.importing.meshes import link_meshes
from casadi_ik.integrations.importing.robot_shapes import robot_shapes
from casadi_ik.integrations.importing.write import FileEntry, HandEntry, ImportedDescription
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.imported_parts import hand_from_file
from casadi_ik.model.joints import (
    Joint,
    chain_to,
    joint_positions,
    joints_below,
    link_poses,
    moving_below,
    rigid_links,
)
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.parts import RobotPart
from casadi_ik.model.schema import HandFromFile
from casadi_ik.model.urdf_mjcf import read_tree
from casadi_ik.model.xml_tree import RobotTree, TreeJoint


@dataclass(frozen=True, eq=False)
class ImportResult:
    """The result of an import.

    Attributes:
        description: Content of the description.
        fingers: Fingers of all hands, hand by hand and each thumb first.
        files: Files of the arm and of the hand; the first is None if there is no file of the arm.
    """

    description: ImportedDescription
    fingers: tuple[FingerChain, ...]
    files: tuple[RobotTree | None, RobotTree]

    def with_home(self, path: Path) -> ImportResult:
        """Return the result with a guessed home configuration.

        Args:
            path: File to which the description was written.

        Raises:
            CasadiIKError: The description cannot be loaded.
        """
        robot = load_description(path)
        home = dict(zip(robot.actuator_names, guess_home(robot).tolist(), strict=True))
        return replace(self, description=replace(self.description, home=home))

    def with_shapes(
        self, path: Path, srdf: Path | None = None, discard: bool = False
    ) -> ImportResult:
        """Return the result with collision shapes of the links.

        Args:
            path: File to which the description was written.
            srdf: SRDF file that lists further pairs of links that may touch.
            discard: Whether to remove the description once it is loaded.

        Raises:
            CasadiIKError: The description cannot be loaded.
        """
        robot = load_description(path)
        if discard:  # shapes take seconds: a process that is killed meanwhile leaves no file behind
            path.unlink()
        shapes, touching, shape_notes = robot_shapes(robot, self.files)
        file_notes = [note for file in self.files if file is not None for note in file.notes]
        description = replace(
            self.description,
            shapes=shapes,
            touching=touching,
            srdf="" if srdf is None else _relative_name(srdf, path),
            notes=[*file_notes, *shape_notes],
        )
        return replace(self, description=description)


def import_robot(
    arm: Path | None,
    hand: Path,
    description_path: Path,
    *,
    command: str,
    tip: str | None = None,
    palm: Sequence[str] = (),
    mount: Sequence[float] | None = None,
    xacro: bool | Sequence[str] = False,
) -> ImportResult:
    """Return the description of a robot without home and shapes.

    Args:
        arm: File of the arm; None if the hand's file contains it, or there is no arm.
        hand: File of the hand or of the complete robot.
        description_path: File to which the description will be written.
        command: Command that is recorded in the description.
        tip: Link of the arm that carries the hand; None to guess it.
        palm: Palm links, one per hand; empty to guess them.
        mount: (6,) pose of the hand's base on the tip [m, rad]; None: identity.
        xacro: Arguments of the files, NAME:=VALUE; True: macros are expanded in files without the
            suffix ``.xacro``.

    Raises:
        CasadiIKError: A file cannot be read, or a choice is invalid or missing.
    """
    if arm is not None and arm.exists() and hand.exists() and arm.samefile(hand):
        raise InputError(
            f"{hand}: arm and hand are the same file; expected two files, or one file with both "
            "(casadi-ik import ROBOT --palm LINK)"
        )
    hand_tree = read_tree(hand, xacro)
    choices = choose_palms(hand_tree, palm)
    if arm is not None and len(choices) > 1:
        raise InputError(f"{hand}: file has several hands; expected no separate file of an arm")
    palm_links = [link for link, _ in choices.values()]
    is_arm_in_file = any(
        joint.type != "fixed" for joint in joints_to_link(hand_tree, palm_links[0])
    )
    key = "robot" if arm is None and is_arm_in_file else "hand"
    hand_file = _hand_file_entry(hand_tree, list(choices.values()), description_path, xacro)
    entries, fingers, notes = [], [], []
    for side, (link, reason) in choices.items():
        joint_names = {joint.name for joint in joints_to_palm(hand_tree, link)}
        schema_entry = HandFromFile(
            file=str(hand.resolve()),
            palm=link,
            locked={n: value for n, value in hand_file.locked.items() if n in joint_names},
            limits={n: limits for n, limits in hand_file.limits.items() if n in joint_names},
            xacro=_xacro_entry(hand, xacro),
        )
        part = hand_from_file(schema_entry, {}, key, description_path)
        entry, hand_fingers, mesh_notes = _describe_hand(hand_tree, part, side, link, reason)
        entries.append(entry)
        fingers += hand_fingers
        notes += mesh_notes
    arm_tree = None if arm is None else read_tree(arm, xacro)
    arm_file = None if arm_tree is None else _arm_file_entry(arm_tree, description_path, tip, xacro)
    if arm is None and (tip is not None or mount is not None):
        option = "--tip" if tip is not None else "--mount"
        raise InputError(f"{option}: option requires a file of the arm; expected ARM and HAND")
    description = ImportedDescription(
        command=command,
        name=description_path.stem,
        arm=arm_file,
        hand=hand_file,
        key=key,
        mount=None if arm is None else list(mount or [0.0] * 6),
        mount_reason="--mount" if mount else "GUESS: the hand's base on the arm's tip",
        hands=entries,
        notes=[*(() if arm_tree is None else arm_tree.notes), *hand_tree.notes, *notes],
    )
    return ImportResult(description, tuple(fingers), (arm_tree, hand_tree))


def _hand_file_entry(
    tree: RobotTree,
    choices: list[LinkChoice],
    description_path: Path,
    xacro: bool | Sequence[str],
) -> FileEntry:
    """Return the entry of the file of one or more hands.

    Args:
        tree: The file.
        choices: Palm link of each hand with its reason.
        description_path: File to which the description will be written.
        xacro: As in `import_robot`.
    """
    palm_links = [link for link, _ in choices]
    joints = list(
        {joint.name: joint for link in palm_links for joint in joints_to_palm(tree, link)}.values()
    )
    spinners = {
        name: value for link in palm_links for name, value in locked_spinners(tree, link).items()
    }
    locked = locked_multi_axis_joints(joints) | spinners
    lock_reasons = dict.fromkeys(spinners, SPINNER_REASON)
    if len(palm_links) > 1:
        unused = locked_unused_joints(tree, joints)
        locked |= unused
        lock_reasons |= dict.fromkeys(unused, UNUSED_JOINT_REASON)
    return FileEntry(
        _relative_name(tree.path, description_path),
        *choices[0],
        assumed_limits(joints),
        locked,
        _xacro_entry(tree.path, xacro),
        lock_reasons,
    )


def _arm_file_entry(
    tree: RobotTree, description_path: Path, tip: str | None, xacro: bool | Sequence[str]
) -> FileEntry:
    """Return the entry of the file of an arm."""
    link, reason = choose_tip(tree, tip)
    joints = joints_to_link(tree, link)
    return FileEntry(
        _relative_name(tree.path, description_path),
        link,
        reason,
        assumed_limits(joints),
        locked_multi_axis_joints(joints),
        _xacro_entry(tree.path, xacro),
    )


def _describe_hand(
    tree: RobotTree, part: RobotPart, side: str, palm: str, reason: str
) -> tuple[HandEntry, list[FingerChain], list[str]]:
    """Return the entry of a hand, its fingers with the thumb first, and notes about its meshes.

    Args:
        tree: File of the hand.
        part: The hand as a part.
        side: Name of the side; "" for a single hand.
        palm: Palm link.
        reason: Reason why this is the palm link.
    """
    fingers = find_fingers(part, palm)
    palm_motors = [joint for joint in chain_to(part, palm) if joint.type != "fixed"]
    if not fingers:
        if len(palm_motors) < MIN_LONE_ARM_JOINTS:
            raise DescriptionError(
                f"{tree.path}: no joint moves below the palm {palm!r}; expected another --palm"
            )
        entry = HandEntry(side, np.eye(4), palm, reason, {"tool": tool_pad(palm)}, None)
        return entry, [FingerChain("tool", (), palm, (palm,), False)], []
    is_jaw = len(fingers) == 1 and len(fingers[0].joints) == 1 and bool(chain_to(part, palm))
    links = {link for finger in fingers for link in _last_links(part, finger)}
    meshes, notes = link_meshes(tree, links | {palm} if is_jaw else links)
    pads = guess_pads(part, palm, fingers, meshes)
    if is_jaw:
        frame = guess_palm_frame(part, palm, fingers, pads, 0)
        fixed_pad = guess_fixed_jaw(part, palm, pads[0], meshes.get(palm))
        entry = HandEntry(
            side,
            frame,
            palm,
            reason,
            {"moving_jaw": pads[0], "fixed_jaw": fixed_pad},
            ("moving_jaw", "the moving jaw"),
        )
        fixed_jaw = FingerChain("fixed_jaw", (), palm, (palm,), False)
        return entry, [replace(fingers[0], name="moving_jaw"), fixed_jaw], notes
    thumb, thumb_reason = guess_thumb(part, fingers, pads)
    frame = guess_palm_frame(part, palm, fingers, pads, thumb)
    names = [finger.name.removeprefix(f"{side}_") for finger in fingers]
    if "thumb" not in names:
        names[thumb] = "thumb"
    order = [thumb, *(i for i in range(len(fingers)) if i != thumb)]
    ordered_pads = {names[i]: pads[i] for i in order}
    entry = HandEntry(side, frame, palm, reason, ordered_pads, (names[thumb], thumb_reason))
    return entry, [replace(fingers[i], name=names[i]) for i in order], notes


def _last_links(part: RobotPart, finger: FingerChain) -> list[str]:
    """Return the links of a finger's last two phalanges, in case the last one has no shape."""
    return [link for joint in finger.joints[-2:] for link in rigid_links(part, joint.child)]


def _xacro_entry(path: Path, xacro: bool | Sequence[str]) -> bool | list[str]:
    """Return the value of the key ``xacro`` of a file."""
    if isinstance(xacro, bool):
        return xacro and path.suffix != ".xacro"
    return list(xacro)


def _relative_name(path: Path, description_path: Path) -> str:
    """Return a file name relative to the description's folder if the file is below it."""
    folder, file = description_path.resolve().parent, path.resolve()
    try:
        return file.relative_to(folder).as_posix()
    except ValueError:
        return file.as_posix()


def read_referenced_tree(path: Path, entry: Mapping[str, Any]) -> RobotTree:
    """Return the robot file that a key ``arm``, ``hand`` or ``robot`` of a description refers to.

    Args:
        path: The description.
        entry: Value of the key.

    Raises:
        CasadiIKError: The file cannot be read.
    """
    file = path.parent / Path(str(entry["file"])).expanduser()
    xacro = entry.get("xacro", False)
    return read_tree(
        file, [str(argument) for argument in xacro] if isinstance(xacro, list) else xacro is True
    )


def find_robot_file(name: str, argument: str = "ROBOT") -> Path:
    """Return a robot file by its path or by its name in the package robot_descriptions.

    Args:
        name: A path, or a name such as "panda_description", whose files that package downloads.
        argument: Name of the command-line argument, for messages.

    Raises:
        InputError: The package has no such name, or cannot download it.
        MissingExtraError: The package is not installed.
    """
    path = Path(name)
    if path.suffix or not re.fullmatch(r"\w+_description", name) or path.exists():
        return path
    try:
        module = import_module(f"robot_descriptions.{name}")
    except ModuleNotFoundError as error:
        if error.name == "robot_descriptions":
            raise MissingExtraError(
                f"{argument}: {name!r} is not a file; to download it by its name: "
                "pip install robot_descriptions"
            ) from error
        raise InputError(f"{argument}: robot_descriptions has no {name!r}") from error
    except Exception as error:  # of git, of the network, of the disk
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{argument}: {name}: cannot be downloaded: {reason}") from error
    files = (getattr(module, f"{kind}_PATH", None) for kind in ("URDF", "MJCF", "XACRO"))
    return Path(next(filter(None, files), name))


ASSUMED_LIMITS = {"revolute": (-math.pi, math.pi), "prismatic": (-0.5, 0.5)}
"""Limits by type of joint if the file states none [rad or m]."""

SPINNER_REASON = "continuous joint, not treated as a finger"

UNUSED_JOINT_REASON = "moves no palm"


def joints_to_palm(tree: RobotTree, palm: str) -> list[TreeJoint]:
    """Return the joints from the root to a palm and all joints below the palm."""
    return [*joints_to_link(tree, palm), *joints_below(tree, palm)]


def joints_to_link(tree: RobotTree, link: str) -> list[TreeJoint]:
    """Return the joints from the root to a link."""
    return list(tree.chain(tree.root, link, str(tree.path)))


def assumed_limits(joints: Sequence[TreeJoint]) -> dict[str, tuple[float, float]]:
    """Return limits for the joints whose file states none."""
    return {
        joint.name: ASSUMED_LIMITS[joint.type]
        for joint in joints
        if joint.type in ASSUMED_LIMITS and joint.limits is None and joint.coupling is None
    }


def locked_multi_axis_joints(joints: Sequence[TreeJoint]) -> dict[str, float]:
    """Return the position zero for each joint with several axes."""
    single_axis = ("fixed", "revolute", "continuous", "prismatic")
    return {joint.name: 0.0 for joint in joints if joint.type not in single_axis}


def locked_unused_joints(tree: RobotTree, used_joints: Sequence[TreeJoint]) -> dict[str, float]:
    """Return positions of the joints that are not used, such as legs and head: zero if possible."""
    names = {joint.name for joint in used_joints}
    return {
        joint.name: float(np.clip(0.0, *(joint.limits or (0.0, 0.0))))
        for joint in tree.joints
        if joint.name not in names and joint.type != "fixed" and joint.coupling is None
    }


def locked_spinners(tree: RobotTree, palm: str) -> dict[str, float]:
    """Return the position zero for continuous joints below a palm, such as propellers.

    The joints are fixed only if another chain may be a finger.
    """
    first_joints = moving_below(tree, palm)
    spinners = [joint for joint in first_joints if is_wheel(tree, joint)]
    return {joint.name: 0.0 for joint in spinners} if len(spinners) < len(first_joints) else {}


HOME_SAMPLES = 300
"""Number of arm postures that are compared for an arm of `FULLY_SAMPLED_JOINTS` or fewer."""

FULLY_SAMPLED_JOINTS = 12
"""Number of joints of an arm up to which all samples are compared."""

JACOBIAN_STEP = 1e-6
"""Step of numerical Jacobians [rad or m]."""

MAX_HOME_OFFSET = np.pi / 2
"""Largest distance of a home position from the middle of the joint range [rad]."""


def guess_home(robot: RobotDescription) -> Array:
    """Return a home configuration (n,): the hand half closed, the arm far from singularities.

    The sides of a multi-arm robot are treated separately, with the trunk at zero.
    """
    middle = (robot.lower + robot.upper) / 2
    if robot.sides:
        home = np.clip(0.0, robot.lower, robot.upper)
        for side, (arm, hand) in zip(robot.sides, robot.side_actuators, strict=True):
            home[sorted((*arm, *hand))] = guess_home(robot.side(side.name))
        return home
    arm = list(robot.arm_actuators)
    if not arm:
        return _rounded(middle, robot)
    chain = robot.chain(robot.palm_link)
    rng = np.random.default_rng(0)
    half_width = np.minimum((robot.upper - robot.lower)[arm] / 4, MAX_HOME_OFFSET)
    best_value, best_q = -1.0, middle
    # The cost of a posture grows with the square of the number of joints.
    samples = int(HOME_SAMPLES * min(1.0, (FULLY_SAMPLED_JOINTS / len(arm)) ** 2))
    for i in range(max(1, samples)):
        q = middle.copy()
        if i:
            q[arm] += half_width * rng.uniform(-1, 1, len(arm))
        value = _smallest_singular_value(robot, chain, q, arm)
        if value > best_value:
            best_value, best_q = value, q
    return _rounded(best_q, robot)


def _smallest_singular_value(
    robot: RobotDescription, chain: tuple[Joint, ...], q: Array, arm: list[int]
) -> float:
    """Return the smallest singular value of the palm Jacobian; 1 m counts as much as 1 rad."""
    pose = _palm_pose(robot, chain, q)
    columns = []
    for i in arm:
        q_step = q.copy()
        q_step[i] += JACOBIAN_STEP
        change = (_palm_pose(robot, chain, q_step) - pose) @ np.linalg.inv(pose) / JACOBIAN_STEP
        columns.append([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    return float(values[: min(6, len(arm))].min())


def _palm_pose(robot: RobotDescription, chain: tuple[Joint, ...], q: Array) -> Array:
    values = joint_positions(robot.joints, dict(zip(robot.actuator_names, q, strict=True)))
    positions = {name: float(value[0]) for name, value in values.items()}
    return link_poses(robot.root, chain, positions)[robot.palm_link]


def _rounded(q: Array, robot: RobotDescription) -> Array:
    """Round to two digits (four for small ranges) where that stays within the limits."""
    rounded = np.where(robot.upper - robot.lower > 0.5, np.round(q, 2), np.round(q, 4))
    is_inside = (rounded > robot.lower) & (rounded < robot.upper)
    return np.where(is_inside, rounded, q)
