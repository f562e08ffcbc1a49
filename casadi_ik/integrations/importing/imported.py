"""A robot from files of its parts or of the whole: chosen, guessed, written, compared with them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from casadi_ik.errors import DescriptionError, InputError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.guess import (
    GUESS_PARAMETERS,
    Branch,
    ends_of_arms,
    find_fingers,
    guess_fixed_jaw,
    guess_home,
    guess_pads,
    guess_palm_frame,
    guess_thumb,
    holds_arms,
    limb_ends,
    palms,
    tool_pad,
)
from casadi_ik.integrations.importing.meshes import link_meshes
from casadi_ik.integrations.importing.robot_shapes import hand_links, name_in_robot, robot_shapes
from casadi_ik.integrations.importing.write import FileLine, HandLines, Written
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.imported_parts import hand_from_file
from casadi_ik.model.joining import MAX_SIDES
from casadi_ik.model.linkage import chain_to, joints_below, leaf_links, moving_below, rigid_links
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.parts import RobotPart
from casadi_ik.model.schema import HandFromFile
from casadi_ik.model.urdf_mjcf import joint_name, read_tree
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

FLANGES = (
    r"tool0$",
    r"flange",
    r"eef|ee_link|end_?effector|attachment|link_?8$|tool",
)
"""Names of the frames on an arm that hands are screwed to, the best first."""

NO_LIMITS = {"revolute": (-math.pi, math.pi), "prismatic": (-0.5, 0.5)}
"""Assumed where a file states none [rad or m]."""


def the_tip(tree: RobotTree) -> tuple[str, str]:
    """The link of an arm that carries the hand, and how it was found.

    Raises:
        InputError: The arm branches, so that there are several.
    """
    last = None
    link = tree.root
    while len(movers := moving_below(tree, link)) == 1:
        last = movers[0]
        link = last.child
    if last is None or (len(movers) > 1 and holds_arms(tree, link)):
        last_ones = leaf_links(tree, tree.root)
        raise InputError(
            f"--tip: missing; {tree.path.name} branches at {link!r}: write the link that carries "
            f"the hand, such as {', '.join(last_ones[:8])}"
        )
    frame = tool_frame(tree, last.child)
    if frame != last.child:
        return frame, f"it is fixed to the last joint ({last.name}) and called so"
    return last.child, f"the last joint ({last.name}) moves it"


def checked_palm(tree: RobotTree, palm: str) -> str:
    """Return the link that is given as a palm.

    Raises:
        InputError: There is no such link.
    """
    if palm not in tree.links:
        raise InputError(
            f"--palm: {tree.path.name} has no link {palm!r}; it has {', '.join(tree.links)}"
        )
    return palm


def no_palm(tree: RobotTree, link: str) -> str:
    """What is said of a link on which rather arms than fingers hang; "" of any other."""
    if link not in palms(tree) or not holds_arms(tree, link):
        return ""
    hands = [one for one in palms(tree) if not holds_arms(tree, one)]
    such = list(dict.fromkeys(hands or ends_of_arms(tree, link)))
    return (
        f"from {link!r} of {tree.path.name} go chains as long as arms: write the link that the "
        f"fingers hang on, such as {', '.join(such[:7])}"
    )


def the_palms(tree: RobotTree, asked: Sequence[str]) -> dict[str, tuple[str, str]]:
    """By side the link that its fingers hang on, and how it was found; one hand has no side.

    Args:
        tree: The file.
        asked: Links that somebody says they are; none: they are looked for.

    Raises:
        InputError: There are no such links, or nothing says which they are.
    """
    for link in asked:
        checked_palm(tree, link)
    several = [(link, "--palm") for link in asked] or guessed_palms(tree)
    if len(several) > MAX_SIDES:
        option = "found" if asked else f"{tree.path.name} has several arms: found"
        raise InputError(
            f"--palm: {option} {len(several)} links, expected {MAX_SIDES} at most; write those "
            f"that fingers hang on or that end an arm: {', '.join(link for link, _ in several[:7])}"
        )
    if len(several) == 1:
        return {"": several[0]}
    for link in asked:
        if asked.count(link) > 1:
            raise InputError(f"--palm: {link!r} is given twice, expected one of each hand")
        if any(joint.child in asked for joint in joints_below(tree, link)):
            raise InputError(f"--palm: {link!r} carries another palm, expected hands side by side")
    names = [_side_name(link) for link, _ in several]
    if "" in names or len(set(names)) < len(names):
        names = [f"side_{i + 1}" for i in range(len(several))]
    return dict(zip(names, several, strict=True))


def guessed_palms(tree: RobotTree) -> list[tuple[str, str]]:
    """Return the palms of a file's hands, or the ends of its arms, and how they were found."""
    limb_end_links = limb_ends(tree)
    if len(limb_end_links) == 1:
        (end,) = limb_end_links
        motors = [
            joint
            for joint in tree.chain(tree.root, end.link, str(tree.path))
            if joint.type != "fixed" and joint.coupling is None
        ]
        if not palms(tree) and len(motors) + end.has_fingers < GUESS_PARAMETERS.lone_arm_joints:
            return [(tree.root, "there is a single chain of joints: the base")]
        if end.has_fingers and len(moving_below(tree, end.link)) > 1:
            return [(end.link, "the first link from which several chains of joints go out")]
    return [
        (end.link, "several chains of joints go out, none as long as an arm")
        if end.has_fingers and len(moving_below(tree, end.link)) > 1
        else (end.link, "an arm with a jaw: the link on which the last joint is")
        if end.has_fingers
        else (tool_frame(tree, end.link), "an arm without a hand ends here")
        for end in limb_end_links
    ]


def tool_frame(tree: RobotTree, link: str) -> str:
    """Return the frame on the last link of an arm that a tool is screwed to: by its name."""
    fixed = rigid_links(tree, link)
    for pattern in FLANGES:
        for name in fixed:
            if re.search(pattern, name.lower()):
                return name
    return link


def _side_name(link: str) -> str:
    """Left or right, as the link's name has it."""
    found = re.search(r"left|right|(?<![a-z])[lr](?![a-z])", link.lower())
    return {"l": "left", "r": "right"}[found[0][0]] if found else ""


def kept_joints(tree: RobotTree, end: str, carried: bool = True) -> list[TreeJoint]:
    """The joints from the root to a link, and those below it unless it is an arm's end."""
    chain = list(tree.chain(tree.root, end, str(tree.path)))
    return chain + (joints_below(tree, end) if carried else [])


def assumed_limits(joints: list[TreeJoint]) -> dict[str, tuple[float, float]]:
    """Limits of the joints whose file states none."""
    return {
        joint.name: NO_LIMITS[joint.type]
        for joint in joints
        if joint.type in NO_LIMITS and joint.limits is None and joint.coupling is None
    }


def assumed_locks(joints: list[TreeJoint]) -> dict[str, float]:
    """Joints that have no single axis stand still."""
    single = ("fixed", "revolute", "continuous", "prismatic")
    return {joint.name: 0.0 for joint in joints if joint.type not in single}


SPINS = "turns without end: no finger"
"""Why a joint stands still."""


def others(tree: RobotTree, kept: Sequence[TreeJoint]) -> dict[str, float]:
    """Where the joints stand that are not of a body: legs, head. At zero, if they can."""
    names = {joint.name for joint in kept}
    return {
        joint.name: float(np.clip(0.0, *(joint.limits or (0.0, 0.0))))
        for joint in tree.joints
        if joint.name not in names and joint.type != "fixed" and joint.coupling is None
    }


def spinners(tree: RobotTree, palm: str) -> dict[str, float]:
    """Joints below a palm that turn without end by themselves: propellers, no fingers.

    They stand still, at zero, if there are other chains that may be fingers.
    """
    first = moving_below(tree, palm)
    found = [
        joint
        for joint in first
        if joint.type == "continuous" and not joint.coupling and not moving_below(tree, joint.child)
    ]
    leaders = {joint.coupling.of for joint in tree.joints if joint.coupling is not None}
    alone = [joint for joint in found if joint.name not in leaders]
    return {joint.name: 0.0 for joint in alone} if len(alone) < len(first) else {}


def file_text(path: Path, out: Path) -> str:
    """A file as a description names it: relative to that, if it is not far from it."""
    here, there = out.resolve().parent, path.resolve()
    try:
        return there.relative_to(here).as_posix()
    except ValueError:
        return there.as_posix()


@dataclass(frozen=True, eq=False)
class Imported:
    """What came out.

    Attributes:
        written: The description.
        branches: The fingers as they were found, the thumb first, hand by hand.
        files: The arm's and the hand's file.
    """

    written: Written
    branches: tuple[Branch, ...]
    files: tuple[RobotTree | None, RobotTree]

    def at_home(self, path: Path) -> Imported:
        """With a home, found for the description as it was written to a path.

        Raises:
            CasadiIKError: The description cannot be loaded.
        """
        description = load_description(path)
        home = guess_home(description).tolist()
        named = dict(zip(description.actuator_names, home, strict=True))
        return replace(self, written=replace(self.written, home=named))

    def with_shapes(self, path: Path, srdf: Path | None = None, discard: bool = False) -> Imported:
        """With the shapes of its links, for the description as it was written to a path.

        Args:
            path: The description.
            srdf: A file that says which links may touch.
            discard: Whether to remove the description once it is loaded.

        Raises:
            CasadiIKError: The description cannot be loaded.
        """
        robot = load_description(path)
        if discard:  # shapes take seconds: a process that is killed meanwhile leaves no file behind
            path.unlink()
        shapes, touching, notes = robot_shapes(robot, self.files)
        notes = [*(note for file in self.files if file is not None for note in file.notes), *notes]
        text = "" if srdf is None else file_text(srdf, path)
        written = replace(
            self.written,
            shapes=shapes,
            touching=touching,
            srdf=text,
            notes=notes,
        )
        return replace(self, written=written)


def import_robot(
    arm: Path | None,
    hand: Path,
    out: Path,
    *,
    command: str,
    tip: str | None = None,
    palm: Sequence[str] = (),
    mount: Sequence[float] | None = None,
    xacro: bool | Sequence[str] = False,
) -> Imported:
    """Choose and guess everything that a description needs but home.

    Args:
        arm: File of the arm; None if the hand's file has it, or there is none.
        hand: File of the hand or of the whole robot.
        out: Where the description will stand.
        command: What made it, for its first line.
        tip: Link of the arm that carries the hand; None: guessed.
        palm: Links that the fingers of a hand hang on, one of each; none: guessed.
        mount: (6,) pose of the hand's base on the tip [m, rad]; None: on it.
        xacro: Values of the files' arguments, NAME:=VALUE; True: macros are expanded in files that
            are not called ``.xacro``.

    Raises:
        CasadiIKError: A file cannot be read, or nothing says what to choose.
    """
    if arm is not None and arm.exists() and hand.exists() and arm.samefile(hand):
        raise InputError(
            f"{hand}: arm and hand are the same file, expected one of each, or one that has "
            "both (casadi-ik import ROBOT --palm LINK)"
        )
    tree = read_tree(hand, xacro)
    found = the_palms(tree, palm)
    body = len(found) > 1
    if arm is not None and body:
        raise InputError(f"{hand}: has several hands, expected no other file that has the arm")
    links = [link for link, _ in found.values()]
    joints = list({one.name: one for link in links for one in kept_joints(tree, link)}.values())
    moved = sum(joint.type != "fixed" for joint in tree.chain(tree.root, links[0], str(hand)))
    key = "robot" if arm is None and moved else "hand"
    limits, locked = assumed_limits(joints), assumed_locks(joints)
    why = dict.fromkeys(
        still := {n: v for link in links for n, v in spinners(tree, link).items()}, SPINS
    )
    if body:
        why |= dict.fromkeys(beside := others(tree, joints), "moves no side")
        still |= beside
    locked |= still
    told = _stated_xacro(hand, xacro)
    hands, branches, notes = [], [], []
    for side, (link, how) in found.items():
        own = {one.name for one in kept_joints(tree, link)}
        entry = HandFromFile(
            file=str(hand.resolve()),
            palm=link,
            locked={name: value for name, value in locked.items() if name in own},
            limits={name: bounds for name, bounds in limits.items() if name in own},
            xacro=told,
        )
        part = hand_from_file(entry, {}, key, out)
        lines, fingers, missing = _found_hand(tree, part, side, link, how)
        hands.append(lines)
        branches += fingers
        notes += missing
    arm_tree = None if arm is None else read_tree(arm, xacro)
    arm_line = None if arm_tree is None else _arm_line(arm_tree, out, tip, xacro)
    if arm is None and (tip is not None or mount is not None):
        option = "--tip" if tip is not None else "--mount"
        raise InputError(f"{option}: there is no arm in a file of its own")
    written = Written(
        command=command,
        name=out.stem,
        arm=arm_line,
        hand=FileLine(
            *(file_text(hand, out), links[0], hands[0].how, limits, locked),
            xacro=told,
            why=why,
        ),
        key=key,
        mount=None if arm is None else list(mount or [0.0] * 6),
        mount_how="--mount" if mount else "GUESS: the hand's base on the arm's tip",
        hands=hands,
        notes=[*(() if arm_tree is None else arm_tree.notes), *tree.notes, *notes],
    )
    return Imported(written, tuple(branches), (arm_tree, tree))


def _found_hand(
    tree: RobotTree, part: RobotPart, side: str, palm: str, how: str
) -> tuple[HandLines, list[Branch], list[str]]:
    """A hand's fingers with their pads, the thumb first, and what cannot be read."""
    branches = find_fingers(part, palm)
    if not branches:
        motors = [joint for joint in chain_to(part, palm) if joint.type != "fixed"]
        if len(motors) < GUESS_PARAMETERS.lone_arm_joints:
            raise DescriptionError(
                f"{tree.path}: no joint moves below the palm {palm!r}; try --palm"
            )
        pad = tool_pad(palm)
        lines = HandLines(side, np.eye(4), palm, how, {"tool": pad}, None)
        return lines, [Branch("tool", (), palm, (palm,), False)], []
    is_jaw = len(branches) == 1 and len(branches[0].chain) == 1 and bool(chain_to(part, palm))
    wanted = {one for branch in branches for one in _ends_of(part, branch)}
    surfaces, notes = link_meshes(tree, wanted | {palm} if is_jaw else wanted)
    pads = guess_pads(part, palm, branches, surfaces)
    if is_jaw:
        pads.append(guess_fixed_jaw(part, palm, pads[0], surfaces.get(palm)))
        frame = guess_palm_frame(part, palm, branches, pads[:1], 0)
        names = ["moving_jaw", "fixed_jaw"]
        lines = HandLines(
            *(side, frame, palm, how, dict(zip(names, pads, strict=True))),
            ("moving_jaw", "the jaw that moves"),
        )
        fixed = Branch("fixed_jaw", (), palm, (palm,), False)
        return lines, [replace(branches[0], name="moving_jaw"), fixed], notes
    thumb, thumb_how = guess_thumb(part, branches, pads)
    frame = guess_palm_frame(part, palm, branches, pads, thumb)
    names = [branch.name.removeprefix(f"{side}_") for branch in branches]
    if "thumb" not in names:
        names[thumb] = "thumb"
    order = [thumb, *(i for i in range(len(branches)) if i != thumb)]
    lines = HandLines(
        *(side, frame, palm, how, {names[i]: pads[i] for i in order}),
        (names[thumb], thumb_how),
    )
    return lines, [replace(branches[i], name=names[i]) for i in order], notes


def _ends_of(part: RobotPart, branch: Branch) -> list[str]:
    """The links of a finger's last two phalanges, one of which has a shape, one hopes."""
    return [link for joint in branch.chain[-2:] for link in rigid_links(part, joint.child)]


def _stated_xacro(path: Path, xacro: bool | Sequence[str]) -> bool | list[str]:
    """Return what a description states about the macros of a file."""
    if isinstance(xacro, bool):
        return xacro and path.suffix != ".xacro"
    return list(xacro)


def _arm_line(tree: RobotTree, out: Path, tip: str | None, xacro: bool | Sequence[str]) -> FileLine:
    if tip is None:
        link, how = the_tip(tree)
    elif tip in tree.links:
        link, how = tip, "--tip"
    else:
        raise InputError(
            f"--tip: {tree.path.name} has no link {tip!r}; it has {', '.join(tree.links)}"
        )
    joints = kept_joints(tree, link, carried=False)
    limits, locked = assumed_limits(joints), assumed_locks(joints)
    told = _stated_xacro(tree.path, xacro)
    return FileLine(file_text(tree.path, out), link, how, limits, locked, told)


def loaded(path: Path) -> ArmHand:
    """The robot of a description that was written."""
    return ArmHand(load_description(path))


def tree_of(path: Path, entry: Mapping[str, Any]) -> RobotTree:
    """The file that a description's ``arm``, ``hand`` or ``robot`` points to.

    Raises:
        CasadiIKError: It cannot be read.
    """
    file = path.parent / Path(str(entry["file"])).expanduser()
    xacro = entry.get("xacro", False)
    return read_tree(
        file, [str(word) for word in xacro] if isinstance(xacro, list) else xacro is True
    )


def file_of(name: str, key: str = "ROBOT") -> Path:
    """A robot's file by its path, or by its name in the package robot_descriptions.

    Args:
        name: A path, or a name such as "panda_description", whose files that package downloads.
        key: Of the argument, for messages.

    Raises:
        InputError: That package knows no such name, or cannot download it.
        MissingExtraError: It is not installed.
    """
    path = Path(name)
    if path.suffix or not re.fullmatch(r"\w+_description", name) or path.exists():
        return path
    try:
        module = import_module(f"robot_descriptions.{name}")
    except ModuleNotFoundError as error:
        if error.name == "robot_descriptions":
            raise MissingExtraError(
                f"{key}: {name!r} is no file; to look for it by name: "
                "pip install robot_descriptions"
            ) from error
        raise InputError(f"{key}: robot_descriptions has no {name!r}") from error
    except Exception as error:  # of git, of the network, of the disk
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{key}: {name}: cannot be downloaded: {reason}") from error
    found = (getattr(module, f"{kind}_PATH", None) for kind in ("URDF", "MJCF", "XACRO"))
    return Path(next(filter(None, found), name))


def largest_difference(
    robot: ArmHand,
    tree: RobotTree,
    q: Array,
    locked: Mapping[str, float] | None = None,
    beside: RobotTree | None = None,
    carried: RobotTree | None = None,
) -> float:
    """How far the links of a robot are from where its file's library has them.

    Args:
        robot: The robot, imported from the file, alone or as a part.
        tree: The file.
        q: (k, n) positions of the actuators [rad or m].
        locked: Joints that the description holds, and where.
        beside: The file of the arm that this file's hand is on, whose names go before.
        carried: The file of the hand that is on this file's arm: a name that it has too may be of
            a link beyond the arm's tip, which the robot does not have.

    Returns:
        The largest entry of the difference of any two poses, relative to the first link of the
        file that the robot has.

    Raises:
        MissingExtraError: Its library is not installed.
    """
    known = _MuJoCo(*tree.model) if tree.model is not None else _Pinocchio(tree.element)
    taken = set() if beside is None else _names(beside)
    links = {link: name_in_robot(link, robot.description.links, taken) for link in tree.links}
    if beside is not None or carried is not None:
        hand = hand_links(robot.description)
        links = {link: ours for link, ours in links.items() if (ours in hand) == (carried is None)}
    joints = {
        one.name: name_in_robot(one.name, robot.description.joint_names, taken)
        for one in tree.joints
    }
    worst = 0.0
    for configuration in q:
        angles = robot.joints(configuration)
        given = {name: angles[ours] for name, ours in joints.items() if ours in angles}
        values = {name: _value(tree, name, given, locked or {}) for name in tree.by_name}
        theirs, found = known.poses(values), robot.links(configuration)
        pairs = [
            (theirs[link], found[ours])
            for link, ours in links.items()
            if ours in found and link in theirs
        ]
        first = pairs[0]
        for one, other in pairs:
            difference = np.linalg.inv(first[0]) @ one - np.linalg.inv(first[1]) @ other
            worst = max(worst, float(np.abs(difference).max()))
    return worst


def _names(tree: RobotTree) -> set[str]:
    return {*tree.links, *tree.by_name}


def _value(
    tree: RobotTree, name: str, given: Mapping[str, float], locked: Mapping[str, float]
) -> float:
    joint = tree.by_name[name]
    if name in given or name in locked:
        return given.get(name, locked.get(name, 0.0))
    if joint.coupling is not None and joint.coupling.of in tree.by_name:
        source = _value(tree, joint.coupling.of, given, locked)
        return float(joint.coupling.followed(np.array([source]))[0])
    if joint.limits is not None and joint.limits[0] == joint.limits[1]:
        return joint.limits[0]
    return 0.0


def _bare(element: Element) -> Element:
    """The links and joints alone: no masses, shapes, transmissions; every joint with its limits."""
    plain = ElementTree.Element("robot", name=element.get("name") or "robot")
    for link in element.findall("link"):
        ElementTree.SubElement(plain, "link", name=link.get("name", ""))
    for joint in element.findall("joint"):
        copy = ElementTree.SubElement(plain, "joint", dict(joint.attrib))
        for kind in ("origin", "parent", "child", "axis", "limit"):
            for part in joint.findall(kind)[:1]:
                if kind == "axis" and not part.get("xyz"):  # as if it were not there
                    continue
                if kind == "limit":  # what URDF demands beside the range
                    part = Element("limit", {"effort": "0", "velocity": "0"} | part.attrib)
                copy.append(part)
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None:
            ElementTree.SubElement(copy, "limit", lower="0", upper="0", effort="0", velocity="0")
    return plain


class _Pinocchio:
    def __init__(self, element: Element | None) -> None:
        assert element is not None  # of a URDF
        try:
            import pinocchio
        except ImportError as error:
            raise MissingExtraError(
                "URDF files are checked by pinocchio, which is not installed (there is none for "
                "Windows): pip install 'casadi-ik[reference]'"
            ) from error
        self._pin: Any = pinocchio
        text = ElementTree.tostring(_bare(element), encoding="unicode")
        self._model = self._pin.buildModelFromXML(text)
        self._data = self._model.createData()

    def poses(self, values: Mapping[str, float]) -> dict[str, Array]:
        q = self._pin.neutral(self._model)
        for name, value in values.items():
            if not self._model.existJointName(name):
                continue
            joint = self._model.joints[self._model.getJointId(name)]
            if joint.nq == 1:
                q[joint.idx_q] = value
            elif joint.nq == 2:  # a turn without end as cosine and sine
                q[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
        self._pin.framesForwardKinematics(self._model, self._data, q)
        return {
            frame.name: self._data.oMf[i].homogeneous
            for i, frame in enumerate(self._model.frames)
            if frame.type == self._pin.BODY
        }


class _MuJoCo:
    def __init__(self, mujoco: Any, model: Any) -> None:
        self._mujoco, self._model = mujoco, model
        self._data = mujoco.MjData(model)

    def poses(self, values: Mapping[str, float]) -> dict[str, Array]:
        model, data = self._model, self._data
        for joint in range(model.njnt):
            name = joint_name(model, joint)
            if name in values:
                data.qpos[model.jnt_qposadr[joint]] = values[name]
        self._mujoco.mj_kinematics(model, data)
        found = {}
        for body in range(model.nbody):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            found[model.body(body).name or f"body_{body}"] = pose
        return found
