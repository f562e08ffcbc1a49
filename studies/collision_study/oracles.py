"""The shapes and pairs of a check by coal through pinocchio, and by MuJoCo."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

import casadi_ik as ik
from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.collision.solids import Kind
from casadi_ik.files.arrays import Array

coal: Any = import_module("coal")
mujoco: Any = import_module("mujoco")
pinocchio: Any = import_module("pinocchio")


def rotation_to(axis: Array) -> Array:
    """(3, 3) whose z is an axis."""
    side = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())]).astype(float)
    side /= np.linalg.norm(side)
    return np.column_stack([side, np.cross(axis, side), axis])


class CoalOracle:
    """pinocchio's kinematics with coal's distances."""

    def __init__(self, robot: ik.ArmHand, around: CollisionQuery) -> None:
        """Build the geometry model: the table's pairs, shape by shape."""
        self._model = pinocchio.buildModelFromXML(robot.urdf())
        self._data = self._model.createData()
        self._names = [j.name for j in robot.description.movable]
        self._robot = robot
        table, geometry = around.table, pinocchio.GeometryModel()
        ids: list[int | None] = []
        for i, capsule in enumerate(robot.description.shapes.capsules):
            length, radius = float(np.linalg.norm(capsule.half_axis)), capsule.radius
            turn = rotation_to(capsule.half_axis / length) if length else np.eye(3)
            shape = coal.Capsule(radius, 2 * length) if length else coal.Sphere(radius)
            ids.append(
                self._add(geometry, f"capsule{i}", capsule.link, turn, capsule.center, shape)
            )
        poses = around.poses if around.poses.ndim == 2 else around.poses[0]
        for k, solid in enumerate(table.solids):
            x, y, z = solid.size.tolist()
            match solid.kind:
                case Kind.BOX:
                    shape = coal.Box(2 * x, 2 * y, 2 * z)
                case Kind.CYLINDER:
                    shape = coal.Cylinder(x, 2 * y)
                case Kind.CAPSULE:
                    shape = coal.Capsule(x, 2 * y) if y else coal.Sphere(x)
                case _:  # of planes: known to coal by corners only, left out here
                    ids.append(None)
                    continue
            if k < table.n_robot_solids:
                solid = robot.description.shapes.solids[k]
                ids.append(
                    self._add(
                        geometry,
                        f"own{k}",
                        solid.link,
                        solid.pose[:3, :3],
                        solid.pose[:3, 3],
                        shape,
                    )
                )
            else:
                flat = poses[k - table.n_robot_solids]
                ids.append(
                    self._add(geometry, f"solid{k}", None, flat[:9].reshape(3, 3), flat[9:], shape)
                )
        pair_numbers: list[int] = []
        for number, (i, j) in enumerate(table.pairs.tolist()):
            first, second = ids[i], ids[j]
            if first is not None and second is not None:
                geometry.addCollisionPair(pinocchio.CollisionPair(first, second))
                pair_numbers.append(number)
        self._geometry, self._offsets = geometry, table.offsets[pair_numbers]
        self._places = pinocchio.GeometryData(geometry)
        self._plain = not robot.description.movable[0].coupling

    def _add(
        self, geometry: Any, name: str, link: str | None, turn: Array, at: Array, shape: Any
    ) -> int:
        place = pinocchio.SE3(turn, np.asarray(at, dtype=float))
        shape.computeLocalAABB()
        if link is None:
            return geometry.addGeometryObject(pinocchio.GeometryObject(name, 0, 0, place, shape))
        frame = self._model.getFrameId(link)
        link_frame = self._model.frames[frame]
        placement = link_frame.placement * place
        return geometry.addGeometryObject(
            pinocchio.GeometryObject(name, link_frame.parentJoint, frame, placement, shape)
        )

    def configurations(self, q: Array) -> Array:
        """(k, nq) pinocchio's configurations."""
        joints = self._robot.joints(q)
        configurations = np.zeros((len(q), self._model.nq))
        for name, values in joints.items():
            if self._model.existJointName(name):
                joint = self._model.joints[self._model.getJointId(name)]
                if joint.nq == 1:
                    configurations[:, joint.idx_q] = values
        return configurations

    def distances(self, q: Array) -> Array:
        """(k, p) distances of all pairs, offsets taken off."""
        distances = np.empty((len(q), len(self._offsets)))
        for row, q_row in enumerate(self.configurations(q)):
            pinocchio.computeDistances(self._model, self._data, self._geometry, self._places, q_row)
            distances[row] = [result.min_distance for result in self._places.distanceResults]
        return distances - self._offsets

    def run(self, q: Array) -> None:
        """Kinematics and collisions of configurations, until the first that is found."""
        for q_row in self.configurations(q):
            pinocchio.computeCollisions(
                self._model, self._data, self._geometry, self._places, q_row, True
            )

    def penetrating(self, q: Array, depth: float) -> NDArray[np.bool_]:
        """Return whether a pair overlaps by more than `depth` [m] plus its allowance (k,)."""
        penetrates = np.zeros(len(q), dtype=bool)
        configurations = self.configurations(q)
        loose = (self._offsets != 0).any()
        for row, q_row in enumerate(configurations):
            hit = pinocchio.computeCollisions(
                self._model, self._data, self._geometry, self._places, q_row, not loose
            )
            if hit and (depth or loose):
                pinocchio.computeDistances(
                    self._model, self._data, self._geometry, self._places, q_row
                )
                min_distances = np.array([r.min_distance for r in self._places.distanceResults])
                hit = bool((min_distances - self._offsets < -depth).any())
            penetrates[row] = hit
        return penetrates


def with_shapes(
    spec: Any, robot: ik.ArmHand, around: CollisionQuery, covers: bool = True
) -> dict[int, str]:
    """Put our shapes into a MuJoCo specification instead of its own, geom "g0", "g1" and so on.

    Args:
        spec: Of the robot, a body per link.
        robot: The robot.
        around: What is checked; a solid of the scene is a body of its own.
        covers: Whether capsules that only enclose others are there as well.

    Returns:
        The body of each shape, by its number in the pairs of the check.
    """
    table, kinds, world = around.table, mujoco.mjtGeom, spec.worldbody
    for geom in list(spec.geoms):
        spec.delete(geom)
    bodies = {body.name: body for body in spec.bodies}
    shapes, link_of_geom = robot.description.shapes, dict[int, str]()
    for i, capsule in enumerate(shapes.capsules):
        if capsule.covers >= 0 and not covers:
            continue
        body = bodies.get(capsule.link, world)
        link_of_geom[i] = body.name
        size, place = [capsule.radius, 0, 0], {"pos": capsule.center}
        if np.any(capsule.half_axis):
            place = {
                "fromto": np.concatenate(
                    [capsule.center - capsule.half_axis, capsule.center + capsule.half_axis]
                )
            }
        kind = kinds.mjGEOM_CAPSULE if np.any(capsule.half_axis) else kinds.mjGEOM_SPHERE
        body.add_geom(name=f"g{i}", type=kind, size=size, **place)
    poses = around.poses.reshape(-1, 12)
    for k, solid in enumerate(table.solids):
        turn, number = np.empty(4), len(shapes.capsules) + k
        if k < table.n_robot_solids:
            link_solid = shapes.solids[k]
            body, rotation, at = (
                bodies.get(link_solid.link, world),
                link_solid.pose[:3, :3],
                link_solid.pose[:3, 3],
            )
        else:
            flat = poses[k - table.n_robot_solids]
            body, rotation, at = world.add_body(name=f"solid{k}"), flat[:9], flat[9:]
        kind = {
            Kind.BOX: kinds.mjGEOM_BOX,
            Kind.CYLINDER: kinds.mjGEOM_CYLINDER,
            Kind.CAPSULE: kinds.mjGEOM_CAPSULE if solid.size[1] else kinds.mjGEOM_SPHERE,
        }[solid.kind]
        mujoco.mju_mat2Quat(turn, np.ascontiguousarray(rotation).ravel())
        body.add_geom(name=f"g{number}", type=kind, pos=at, quat=turn, size=solid.size)
        link_of_geom[number] = body.name
    return link_of_geom


class MuJoCoOracle:
    """MuJoCo's kinematics and collisions."""

    def __init__(self, robot: ik.ArmHand, around: CollisionQuery) -> None:
        """Read the robot's URDF and put the shapes in."""
        self._robot, table = robot, around.table
        compiler = '<compiler fusestatic="false" boundmass="0.01" boundinertia="0.001"/>'
        urdf = robot.urdf().replace("<link", f"<mujoco>{compiler}</mujoco><link", 1)
        spec = mujoco.MjSpec.from_string(urdf)
        links = with_shapes(spec, robot, around, covers=False)
        # What is no pair of the table is excluded; those that may overlap a little are left out.
        pair_numbers = {
            frozenset((links.get(i, table.names[p][0]), links[j]))
            for p, (i, j) in enumerate(table.pairs.tolist())
            if not table.offsets[p]
        }
        names = sorted(set(links.values()))
        for a, first in enumerate(names):
            for second in names[a + 1 :]:
                if frozenset((first, second)) not in pair_numbers:
                    spec.add_exclude(bodyname1=first, bodyname2=second)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._places = {
            joint.name: self._model.jnt_qposadr[self._model.joint(joint.name).id]
            for joint in robot.description.movable
        }

    def _configurations(self, q: Array) -> Array:
        configurations = np.zeros((len(q), self._model.nq))
        for name, values in self._robot.joints(q).items():
            configurations[:, self._places[name]] = values
        return configurations

    def run(self, q: Array) -> None:
        """Kinematics and collisions of configurations."""
        for q_row in self._configurations(q):
            self._data.qpos = q_row
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_collision(self._model, self._data)

    def touching(self, q: Array, depth: float) -> NDArray[np.bool_]:
        """Return whether a pair overlaps by more than `depth` [m] (k,)."""
        touches = np.zeros(len(q), dtype=bool)
        for row, q_row in enumerate(self._configurations(q)):
            self._data.qpos = q_row
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_collision(self._model, self._data)
            touches[row] = self._data.ncon > 0 and bool((self._data.contact.dist < -depth).any())
        return touches
