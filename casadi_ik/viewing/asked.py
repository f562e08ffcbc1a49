"""What is asked on a page: contacts that hang on controls, an object, a scene, settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.grasps import Contact, Grasp, Tolerance
from casadi_ik.grasps.pose import inverse
from casadi_ik.registry import METHODS
from casadi_ik.viewing.frames import facing


@dataclass(frozen=True)
class Settings:
    """How it is solved.

    Attributes:
        method: One of `METHODS`.
        tolerance: When a contact counts as reached.
        limits: "enforce" or "ignore".
        prefer: Which of several solutions; "q0": the one nearest to what is shown.
    """

    method: str = METHODS[0]
    tolerance: Tolerance = field(default_factory=Tolerance)
    limits: str = "enforce"
    prefer: str = "q0"


@dataclass(frozen=True, eq=False)
class Held:
    """A contact that moves with a control.

    Attributes:
        contact: In the control's frame.
        control: (4, 4) where the control is, base frame.
        used: Whether the contact is asked for.
        normal: Whether its normal is.
    """

    contact: Contact
    control: Array
    used: bool = True
    normal: bool = True

    @cached_property
    def placed(self) -> Contact:
        """The contact in the base frame, with what is asked of it."""
        found = self.contact.at(self.control)
        if self.normal or not np.isfinite(found.point).all():
            return found
        return Contact(found.point, tolerance=found.tolerance, line=found.line, plane=found.plane)


@dataclass(frozen=True, eq=False)
class Asked:
    """A question; moved things give another one.

    Attributes:
        held: Contact by finger, of all fingers of the robot that may have one.
        name: What the grasp is called.
        robot: Name or path of the robot.
        object: Name of the object that is grasped; "" if there is none.
        object_pose: (4, 4) where it is; None if there is none.
        scene: What stands about the robot; None: nothing is checked.
        settings: How it is solved.
    """

    held: Mapping[str, Held]
    name: str = ""
    robot: str = ""
    object: str = ""
    object_pose: Array | None = None
    scene: Scene | None = None
    settings: Settings = Settings()

    @cached_property
    def grasp(self) -> Grasp:
        """The grasp; at least one finger is used."""
        contacts = {name: one.placed for name, one in self.held.items() if one.used}
        return Grasp(contacts, self.robot, self.name, self.object, self.object_pose)

    def with_control(self, finger: str, pose: Array) -> Asked:
        """A contact dragged: its control is at another (4, 4) pose."""
        return self._held(finger, replace(self.held[finger], control=pose))

    def with_point(self, finger: str, point: Array) -> Asked:
        """A contact moved to a point (3,) [m], facing as before."""
        pose = self.held[finger].control.copy()
        pose[:3, 3] = point
        return self.with_control(finger, pose)

    def with_normal(self, finger: str, normal: Array) -> Asked:
        """A contact turned so that its control's x axis, its normal, faces another way (3,)."""
        pose = self.held[finger].control
        return self.with_control(finger, facing(pose[:3, 3], normal, pose[:3, :3]))

    def with_use(self, finger: str, used: bool, normal: bool) -> Asked:
        """A finger taken in or left free; as it is if it is the last one that is used."""
        changed = self._held(finger, replace(self.held[finger], used=used, normal=normal))
        return changed if any(one.used for one in changed.held.values()) else self

    def with_object(self, pose: Array) -> Asked:
        """The object moved to a (4, 4) pose, and all contacts with it."""
        assert self.object_pose is not None
        step = pose @ inverse(self.object_pose)
        held = {
            name: replace(one, control=_rigid(step @ one.control))
            for name, one in self.held.items()
        }
        return replace(self, held=held, object_pose=pose)

    def with_item(self, name: str, pose: Array) -> Asked:
        """Something in the scene moved to a (4, 4) pose.

        Raises:
            CasadiIKError: There is no such thing.
        """
        assert self.scene is not None
        return replace(self, scene=self.scene.moved(name, pose))

    def _held(self, finger: str, one: Held) -> Asked:
        return replace(self, held={**self.held, finger: one})


def asked_of(
    robot: ArmHand,
    grasp: Grasp | None,
    q: Array | None,
    scene: Scene | None = None,
    settings: Settings | None = None,
) -> Asked:
    """The first question of a page.

    Args:
        robot: The robot.
        grasp: What is asked; None: the contacts that are reached at q.
        q: (n,) where the robot is [rad or m]; None: at home.
        scene: What stands about.
        settings: How it is solved.

    Raises:
        InputError: The grasp has a finger that the robot has not.
    """
    frames = robot.contact_frames(robot.configuration(q))
    given = {} if grasp is None else dict(grasp.contacts)
    if grasp is not None:
        grasp.arrays(robot.fingers)
    held: dict[str, Held] = {}
    for finger, frame in zip(robot.fingers, frames, strict=True):
        contact = given.get(finger)
        used = contact is not None or grasp is None
        contact = contact or Contact(frame[:3, 3], frame[:3, 0])
        place = contact.point if np.isfinite(contact.point).all() else frame[:3, 3]
        normal = frame[:3, 0] if contact.normal is None else contact.normal
        control = facing(place, normal, frame[:3, :3])
        if contact.normal is None and contact.line is None and contact.plane is None:
            # Its normal is at hand if it is wanted after all.
            whole = Contact(place, normal, contact.tolerance)
            held[finger] = Held(whole.at(inverse(control)), control, used, normal=False)
        else:
            held[finger] = Held(contact.at(inverse(control)), control, used)
    name, thing, pose = (
        ("", "", None)
        if grasp is None
        else (
            grasp.name,
            grasp.object,
            grasp.object_pose,
        )
    )
    settings = settings or Settings()
    return Asked(held, name, robot.name, thing, pose, scene, settings)


def _rigid(pose: Array) -> Array:
    """A pose without what rounding has added to its rotation over many steps."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ vt
    return pose
