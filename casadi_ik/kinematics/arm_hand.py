"""Robots with their compiled forward kinematics."""

from __future__ import annotations

import warnings
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, InputWarning
from casadi_ik.files.arrays import Array
from casadi_ik.files.reprs import ReprMixin
from casadi_ik.kinematics.robot_kernels import RobotKernels
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import real_array
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.write_urdf import to_urdf


class ArmHand(ReprMixin):
    """A robot: an arm with a hand, an arm alone, or a hand on a fixed base.

    Attributes:
        description: Immutable description of links, joints and fingers.

    Example:
        >>> robot.name, robot.fingers, robot.thumb
        ('kuka_lwr_barrett', ('thumb', 'finger_2', 'finger_3'), 'thumb')
        >>> len(robot.actuators), robot.actuators[7]
        (14, 'bh_spread')
        >>> bool(np.all((robot.lower <= robot.home) & (robot.home <= robot.upper)))
        True
    """

    def __init__(self, description: RobotDescription) -> None:
        """Wrap a description; kernels are compiled at the first use and cached on the machine."""
        self.description = description

    def __reduce__(self) -> tuple[type[ArmHand], tuple[RobotDescription]]:
        """Return the description; a copy uses the kernels cached on its machine."""
        return type(self), (self.description,)

    def __repr__(self) -> str:
        return f"<ArmHand {self.name}: {len(self.actuators)} actuators, fingers {self.fingers}>"

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.description.name

    @property
    def fingers(self) -> tuple[str, ...]:
        """Names of the fingers, in the order of `contacts`."""
        return self.description.finger_names

    @property
    def thumb(self) -> str:
        """Name of the finger that thumb-first methods place first."""
        return self.description.thumb

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the actuators, in the order of q."""
        return self.description.actuator_names

    @property
    def sides(self) -> tuple[str, ...]:
        """Names of the sides of a multi-arm robot; () for one arm-hand.

        Example:
            >>> robot.sides
            ()
        """
        return tuple(side.name for side in self.description.sides)

    @property
    def trunk(self) -> tuple[str, ...]:
        """Names of the actuators that move every palm of a multi-arm robot."""
        return self.description.trunk

    def side(self, name: str) -> ArmHand:
        """Return one arm-hand of a multi-arm robot, with the trunk as the first joints of its arm.

        The base frame and the names of motors, links and fingers remain. The other sides are
        removed, so that collisions with them are not checked.

        Raises:
            UnknownNameError: The side does not exist; the message lists the sides.

        Example:
            >>> ik.load_robot("g1+dex3").side("left").actuators[:2]
            ('waist_yaw_joint', 'waist_roll_joint')
        """
        return type(self)(self.description.side(name, with_trunk=True))

    @property
    def lower(self) -> Array:
        """Lower limits of the actuators (n,), including those of their joints [rad or m]."""
        return self.description.lower

    @property
    def upper(self) -> Array:
        """Upper limits of the actuators (n,), including those of their joints [rad or m]."""
        return self.description.upper

    @property
    def home(self) -> Array:
        """Home configuration (n,) [rad or m]."""
        return self.description.home

    def configuration(self, q: ArrayLike | None, name: str = "q") -> Array:
        """Return a configuration as a checked array; `home` for None.

        Args:
            q: (n,) or (k, n) actuator positions [rad or m].
            name: Name of the argument in errors.

        Raises:
            InputError: The shape is wrong or a value is not finite.
        """
        if q is None:
            return self.home.copy()
        try:
            array = real_array(q)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: found {q!r}, expected numbers: {error}") from error
        n = len(self.actuators)
        if array.ndim not in (1, 2) or array.shape[-1] != n:
            raise InputError(f"{name}: found shape {array.shape}, expected ({n},) or (k, {n})")
        if not np.all(np.isfinite(array)):
            raise InputError(f"{name}: contains NaN or infinity; expected finite numbers")
        return array

    def start(self, q0: ArrayLike | None, name: str = "q0") -> Array:
        """Return a checked start configuration; `home` for None.

        A motor more than one revolution beyond its limits raises a warning, because q0 may be in
        degrees.

        Raises:
            InputError: As for `configuration`.

        Example:
            >>> bool((robot.start(None) == robot.home).all())
            True
        """
        start = self.configuration(q0, name)
        if q0 is None:
            return start
        middle, max_distance = self._plausible_range
        is_far = np.abs(start - middle) > max_distance
        if is_far.any():
            *_, i = np.argwhere(is_far)[0].tolist()
            value, limits = start[is_far][0], f"{self.lower[i]:.3g} to {self.upper[i]:.3g}"
            text = (
                f"{name}: {self.actuators[i]} is {value:g} rad, far beyond its limits {limits} rad"
            )
            # One fixed location, so that Python shows the warning once.
            warnings.warn(f"{text}; degrees are np.deg2rad(...)", InputWarning, stacklevel=1)
        return start

    @cached_property
    def _plausible_range(self) -> tuple[Array, Array]:
        """Centres of the motor ranges (n,), and distances from them that are plausible (n,)."""
        units = [actuator.unit for actuator in self.description.actuators]
        limited = [unit == "rad" for unit in units] & ~self.description.continuous
        turn = np.where(limited, 2 * np.pi, np.inf)
        return (self.lower + self.upper) / 2, (self.upper - self.lower) / 2 + turn

    def joints(self, q: ArrayLike) -> dict[str, Any]:
        """Return the positions of all movable joints after the couplings.

        Args:
            q: (n,) or (k, n) actuator positions.

        Returns:
            Positions by joint name: floats, or (k,) for a batch [rad or m].

        Raises:
            InputError: See `configuration`.

        Example:
            >>> joints = robot.joints(robot.home)  # one motor spreads two fingers
            >>> len(robot.actuators), len(joints)
            (14, 15)
            >>> print(round(np.rad2deg(joints["lwr_joint_2"]), 6))
            30.0
        """
        configuration, names = self.configuration(q), self.description.joint_names
        (theta,) = self._kernels.joints(_for_kernels(configuration))
        # Kernels of a robot with one joint return scalars.
        return _by_name(names, theta.reshape(*configuration.shape[:-1], len(names)))

    def toggle_margins(self, q: ArrayLike) -> dict[str, Any]:
        """Return the distance of every lead screw and four-bar from its singular (toggle) position.

        Args:
            q: (n,) or (k, n) actuator positions.

        Returns:
            Squared sine of the transmission angle by joint, a float or (k,) for a batch: 1 at
            best, 0 at the toggle, negative where the mechanism cannot be assembled. Empty if the
            robot has no such couplings.

        Raises:
            InputError: See `configuration`.
        """
        configuration = self.configuration(q)
        names, kernel = self._kernels.toggle_margins
        if not names:
            return {}
        (margins,) = kernel(configuration)
        return _by_name(names, margins.reshape(*configuration.shape[:-1], len(names)))

    def contacts(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return the contact points and pad normals of all fingertips.

        Args:
            q: (n,) or (k, n) actuator positions.

        Returns:
            Points (f, 3) [m] and outward unit pad normals (f, 3), base frame; (k, f, 3) for a
            batch.

        Raises:
            InputError: See `configuration`.

        Example:
            >>> points, normals = robot.contacts(robot.home)
            >>> points.shape, bool(np.allclose(np.linalg.norm(normals, axis=1), 1))
            ((3, 3), True)
        """
        points, normals = self._kernels.contacts(_for_kernels(self.configuration(q)))
        return points, normals

    def contact_frames(self, q: ArrayLike) -> Array:
        """Return the contact frames of all fingers, base frame.

        The origin is the contact point. The first axis is the outward pad normal. The second
        is the tangent of the pad: ``tangent`` of the description, else the x axis of the contact
        frame, orthogonalised to the normal. The third is normal x tangent.

        Args:
            q: (n,) or (k, n) actuator positions.

        Returns:
            (f, 4, 4), or (k, f, 4, 4) for a batch.

        Raises:
            InputError: See `configuration`.

        Example:
            >>> frames = robot.contact_frames(robot.home)
            >>> bool(np.allclose(frames[:, :3, 0], robot.contacts(robot.home)[1]))
            True
        """
        return self.frames_at(self.configuration(q))

    def frames_at(self, q: Array) -> Array:
        """Return `contact_frames` without checking q; NaN gives NaN."""
        (frames,) = self._kernels.contact_frames(_for_kernels(q))
        return frames.reshape(*frames.shape[:-2], len(self.fingers), 4, 4)

    def errors(self, q: ArrayLike, points: ArrayLike, normals: ArrayLike) -> tuple[Array, Array]:
        """Return the errors of the fingertips with respect to contacts.

        Args:
            q: (n,) or (k, n) actuator positions.
            points: (f, 3) or (k, f, 3) [m], base frame; NaN where free.
            normals: (f, 3) or (k, f, 3), unit; NaN where free.

        Returns:
            Distances [m] and angles [rad], (f,) or (k, f); NaN where free.

        Raises:
            InputError: See `configuration`.

        Example:
            >>> points, normals = robot.contacts(robot.home)
            >>> position, angle = robot.errors(robot.home, points + [0, 0, 0.01], normals)
            >>> print(np.round(1e3 * position, 6))
            [10. 10. 10.]
        """
        position, angle, _ = self.deviations(
            self.configuration(q), np.asarray(points), np.asarray(normals)
        )
        return position, angle

    def deviations(self, q: Array, points: Array, normals: Array) -> tuple[Array, Array, Array]:
        """Return `errors` and `beyond_limits` without checking q.

        Args:
            q: (n,) or (k, n) actuator positions; NaN gives NaN.
            points: (f, 3) or (k, f, 3) [m], base frame; NaN where free.
            normals: (f, 3) or (k, f, 3), unit; NaN where free.

        Returns:
            Distances [m] and angles [rad], each (f,) or (k, f), and the largest violation of a
            limit [rad or m], () or (k,).
        """
        position, angle, excess = self._kernels.deviations(_for_kernels(q), points, normals)
        # Kernels return scalars for a single finger.
        by_finger = (*excess.shape, len(self.fingers))
        return position.reshape(by_finger), angle.reshape(by_finger), excess

    def beyond_limits(self, q: ArrayLike) -> Array:
        """Return the largest violation of a limit [rad or m], () or (k,); negative within limits.

        Raises:
            InputError: See `configuration`.
        """
        (excess,) = self._kernels.limit_excess(_for_kernels(self.configuration(q)))
        return excess

    def palm(self, q: ArrayLike, side: str | None = None) -> Array:
        """Return the pose of the palm frame in the base frame, (4, 4) or (k, 4, 4).

        Args:
            q: (n,) or (k, n) actuator positions.
            side: Side of a multi-arm robot (default: the only one).

        Raises:
            InputError: See `configuration`; or the side of a multi-arm robot is missing.
            UnknownNameError: The side does not exist.

        Example:
            >>> robot.palm(robot.home).shape
            (4, 4)
        """
        if side is None and len(self.sides) == 1:
            (side,) = self.sides
        if side is not None:
            selected = self.description.get_side(side)
            return self.links(q)[selected.palm_link] @ selected.palm_placement
        if self.sides:
            raise InputError(f"side: found None, expected one of {', '.join(self.sides)}")
        (pose,) = self._kernels.palm(_for_kernels(self.configuration(q)))
        return pose

    @cached_property
    def hands(self) -> dict[str | None, tuple[int, ...]]:
        """Indices in `fingers` by side; the key is None for a single hand.

        Example:
            >>> robot.hands
            {None: (0, 1, 2)}
        """
        index = {name: i for i, name in enumerate(self.fingers)}
        sides = self.description.sides
        if not sides:
            return {None: tuple(index.values())}
        return {side.name: tuple(index[name] for name in side.fingers) for side in sides}

    def links(self, q: ArrayLike) -> dict[str, Array]:
        """Return the pose of every link frame in the base frame, by link name.

        Args:
            q: (n,) or (k, n) actuator positions.

        Returns:
            Poses by link name: (4, 4), or (k, 4, 4) for a batch.

        Raises:
            InputError: See `configuration`.

        Example:
            >>> robot.links(robot.home)["lwr_flange"].shape
            (4, 4)
        """
        (poses,) = self._kernels.links(_for_kernels(self.configuration(q)))
        names = self.description.links
        stacked = poses.reshape(*poses.shape[:-2], len(names), 4, 4)
        return {name: stacked[..., i, :, :] for i, name in enumerate(names)}

    def random(self, rng: np.random.Generator, count: int) -> Array:
        """Return configurations (count, n) uniform within the limits.

        Example:
            >>> robot.random(np.random.default_rng(0), 100).shape
            (100, 14)
        """
        return rng.uniform(self.lower, self.upper, (count, len(self.actuators)))

    def urdf(self) -> str:
        """Return the robot as URDF text, see `casadi_ik.model.to_urdf`.

        Example:
            >>> robot.urdf().count("<joint ") >= 15
            True
        """
        return self._urdf

    def view(self, q: ArrayLike | None = None, **options: Any) -> Any:
        """Show the robot in the browser or a notebook; requires the extra `view`.

        Args:
            q: (n,) configuration [rad or m] (default: `home`).
            options: Options of `casadi_ik.app.viewer.view_grasp`: grasp, scene, host, port.

        Returns:
            The running `casadi_ik.app.viewer.Viewer`.

        Raises:
            MissingExtraError: viser is not installed.
            InputError: See `configuration`.
        """
        return import_module("casadi_ik.app.viewer").view_grasp(
            self, q=self.configuration(q), **options
        )

    @cached_property
    def _urdf(self) -> str:
        return to_urdf(self.description)

    @cached_property
    def _kernels(self) -> RobotKernels:
        return RobotKernels(self.description)


def _for_kernels(q: Array) -> Array:
    """Return q with the shape that kernels take: without the last axis for a single motor."""
    return q[..., 0] if q.shape[-1] == 1 else q


def load_robot(name_or_path: str | Path) -> ArmHand:
    """Load a robot.

    Args:
        name_or_path: Name of a shipped robot (see `casadi-ik robots`), of a shipped arm and hand
            ("panda+allegro_right"), or path of a YAML file.

    Raises:
        UnknownNameError: The name is not that of a shipped robot.
        DescriptionError: The file is missing or malformed; the message names file and key.

    Example:
        >>> ik.load_robot("panda+allegro_right")
        <ArmHand panda+allegro_right: 23 actuators, fingers ('thumb', 'index', 'middle', 'ring')>
    """
    return ArmHand(load_description(name_or_path))


def _by_name(names: tuple[str, ...], values: Array) -> dict[str, Any]:
    """Return values (m,) or (k, m) by name: floats, or (k,) for a batch."""
    if values.ndim == 1:
        return {name: float(value) for name, value in zip(names, values, strict=True)}
    return dict(zip(names, values.T, strict=True))
