"""Do grasps of surfaces hold? What `grasps_of` finds, squeezed in MuJoCo, and pulled six ways.

Every grasp has to hold 0.2 kg against a force as large as its weight along each axis of the base
frame, both ways: the object moves less than 20 mm and turns less than 30 deg in a second, in all
six. How well the load predicts that is the area under its ROC curve. Then the object is a bit
elsewhere than the hand believes, and the hand closes on it::

    python studies/touch_hold.py
    python studies/touch_hold.py --robots panda+leap --objects cup mug --limit 20
    python studies/touch_hold.py --objects ycb/*.obj --out results/touch_hold_ycb

(with the google_16k scans of elpis-lab/ycb_dataset, MIT, whose `textured.obj` are named as their
folders). Needs MuJoCo (``pip install mujoco``).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from runner.figures import RESULTS
from runner.parts import code_version
from runner.report import (
    Metric,
    command,
    markdown_table,
    program,
    publish,
    rate_metric,
)
from runner.study import robot_of, standing

import casadi_ik as ik
from casadi_ik.collision.solids import object_solids
from casadi_ik.planning.touch.found_grasps import FoundGrasp, random_displacements

mujoco: Any = import_module("mujoco")

ROBOTS = (
    "panda+allegro_right",
    "panda+leap",
    "ur5e+shadow",
    "kuka_lwr_barrett",
    "panda+unitree_dex3",
    "panda+panda_hand",
    "panda+robotiq_2f85",
)

MASS, GRAVITY, FRICTION, PATCH = 0.2, 9.80665, 0.5, 0.005
SQUEEZE = 18.0
"""Sum of the normal forces [N]: 6 N a finger of three."""

PAD = 0.010
"""Radius of a flat pad's ball [m]."""

STIFFNESS = {"revolute": 3.0, "prismatic": 2000.0}
"""Stiffness of a motor [N m/rad, N/m]."""

STEP, SETTLING, TIME = 2e-3, 0.4, 1.0
"""Time step, and durations before and with the force [s]."""

MAX_DISPLACEMENT, MAX_ROTATION = 0.020, np.deg2rad(30.0)
"""Largest displacement [m] and rotation [rad] of a held object."""

STATE_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION


INTRODUCTION = """
{names}: each stands on the table, rotated by 40 deg, 0.5 m in front of the base of the arm and
0.1 m to the side. At most {limit} distinct, force-closed grasps of each are computed (friction
0.5, three fingertips, or two of a gripper). The {best} with the highest load are tested, and
every {every}th regardless of its load. In MuJoCo the palm is fixed, motors are springs (3 N
m/rad, 2 kN/m), pads are balls as in the description of the hand (flat ones of 10 mm), only pads
touch the object (its convex parts; friction 0.5, torsional friction of a patch of 5 mm), and it
weighs 0.2 kg. The total grip force is 18 N, distributed by `FoundGrasp.forces`. *Held*: within a
second the object moves less than 20 mm and rotates less than 30 deg, for a force of its weight in
each of six directions. *Best third*: the third with the highest load among the {best} best of all
objects. *AUC*: in pairs of one grasp that held and one that did not, how often the one that held
has the higher load, among every {every}th. *Strong*: those of these whose load exceeds the
weight.
"""

NOISE = """
The object is displaced by 5 mm and 3 deg, once for each displacement and each of the best grasps
({samples} in random directions); the hand closes from its open posture. *Robustness* is
`FoundGrasps.robustness`: the fraction of displacements for which the resulting contacts hold 0.2
kg by their load. *Held*: the fraction that hold the object against gravity in MuJoCo. *AUC*: in
pairs of grasps, how often the one that holds more often has the higher robustness, or load.
"""


def main(arguments: list[str] | None = None) -> None:
    """Hold grasps and write the report."""
    parser = argparse.ArgumentParser(description="Simulate grasps in MuJoCo.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--objects", nargs="+", default=ik.shipped_names("objects"))
    parser.add_argument("--limit", type=int, default=200, help="grasps that are found of an object")
    parser.add_argument("--best", type=int, default=12, help="of which so many best are tried ...")
    parser.add_argument("--every", type=int, default=4, help="... and every so many-th")
    parser.add_argument("--samples", type=int, default=4, help="displacements of a grasp")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS / "touch_hold")
    parser.add_argument("--title", default="Simulated grasps", help="title of the report")
    options = parser.parse_args(arguments)
    surfaces = [ik.load_surface(name, seed=options.seed) for name in options.objects]
    names = ", ".join(name_of(surface) for surface in surfaces)
    rows, noisy, objects, metrics = [], [], [], list[Metric]()
    for robot in options.robots:
        solver = ik.Solver(robot_of(robot), scene=ik.load_scene("table"))
        tries = [
            trial
            for surface in track(surfaces, robot)
            for trial in try_grasps(solver, surface, options)
        ]
        rows.append(row_of(robot, tries, metrics))
        noisy.append(noise_of(robot, tries, metrics))
        for surface in surfaces:
            is_held = [
                trial.is_held for trial in tries if trial.best and trial.object == name_of(surface)
            ]
            objects.append([robot, name_of(surface), str(len(is_held)), str(sum(is_held))])
    heads = ["robot", "best", "held", "best third held", "any", "held", "AUC of load"]
    third_held, third = (sum(int(row[3].split(" of ")[i]) for row in rows) for i in (0, 1))
    result = f"{third_held} of {third} grasps in the best third by load hold the object."
    parts = [
        INTRODUCTION.format(names=names, **vars(options)),
        markdown_table([*heads, "AUC of closure", "strong", "of them held"], rows),
        "## Noise",
        NOISE.format(samples=options.samples),
        markdown_table(["robot", "robustness", "held", "AUC of robustness", "AUC of load"], noisy),
        "## The best by object",
        markdown_table(["robot", "object", "grasps", "held"], objects),
    ]
    run_by, code = command(__file__, arguments), {"touch_hold": code_version()}
    publish(options.title, result, parts, options.out, run_by, code, metrics)


def name_of(surface: ik.Surface) -> str:
    """Return the name of an object, or of a mesh without its folder."""
    return Path(surface.object.name).stem


@dataclass(frozen=True)
class Trial:
    """A grasp and how it went.

    Attributes:
        object: What is grasped.
        load: Its load [N/N].
        closure: Its closure.
        is_held: Whether it was held six ways.
        best: Whether it is one of the best ...
        any: ... and whether it was taken whatever its load.
        robustness: Of the geometry; NaN if it is none of the best.
        noisy: Share of displacements at which it was held; likewise.
    """

    object: str
    load: float
    closure: float
    is_held: bool
    best: bool
    any: bool
    robustness: float
    noisy: float


def try_grasps(
    solver: ik.Solver, surface: ik.Surface, options: argparse.Namespace
) -> Iterator[Trial]:
    """Grasps of an object, as they went."""
    limit, seed = options.limit, options.seed
    grasps = solver.grasps_of(surface, standing(surface, 0.7), limit=limit, among=limit, seed=seed)
    best_grasps = replace(grasps, entries=grasps[: options.best])
    shares = best_grasps.robustness(hold=(MASS, SQUEEZE), seed=seed)
    displacements = random_displacements(
        5e-3, np.deg2rad(3.0), options.samples, seed + 1, surface.middle
    )
    six = np.concatenate([np.eye(3), -np.eye(3)])
    for place, trial in enumerate(grasps):
        best, any_ = place < options.best, place % options.every == 0
        if not (best or any_):
            continue
        hold = Hold(solver.robot, trial, surface)
        is_held = bool(hold.is_held(hold.settled(), six).all())
        share = mean = math.nan
        if best:
            noisy = [
                bool(hold.is_held(hold.settled(off), -np.eye(3)[2:]).all()) for off in displacements
            ]
            share, mean = float(shares[place]), float(np.mean(noisy)) if noisy else math.nan
        yield Trial(name_of(surface), trial.load, trial.closure, is_held, best, any_, share, mean)


def row_of(robot: str, tries: Sequence[Trial], metrics: list[Metric]) -> list[str]:
    """Return the row of a robot."""
    name = f"touch_hold/{robot}"
    best = sorted((trial for trial in tries if trial.best), key=lambda trial: -trial.load)
    unselected = [trial for trial in tries if trial.any]
    is_held = np.array([trial.is_held for trial in unselected], dtype=bool)
    loads, closures = (
        np.array([[trial.load, trial.closure] for trial in unselected]).reshape(-1, 2).T
    )
    groups = {
        "held": best,
        "best_third": best[: len(best) // 3],
        "held_of_any": unselected,
        "strong": [trial for trial in unselected if trial.load >= MASS * GRAVITY / SQUEEZE],
    }
    rates = [
        rate_metric(f"{name}/{key}", sum(trial.is_held for trial in group), len(group))
        for key, group in groups.items()
    ]
    areas = concordance(loads, is_held), concordance(closures, is_held)
    metrics += [
        *rates,
        Metric(f"{name}/auc", areas[0], "", "higher", math.nan, math.nan, len(unselected)),
    ]
    shares = [f"{rate.value:.0f} %" for rate in rates]
    third, strong = (
        f"{sum(trial.is_held for trial in groups[key])} of {len(groups[key])}"
        for key in ("best_third", "strong")
    )
    return [
        *(robot, str(len(best)), shares[0], third, str(len(unselected)), shares[2]),
        *(f"{area:.3f}" for area in areas),
        *(str(len(groups["strong"])), strong),
    ]


def noise_of(robot: str, tries: Sequence[Trial], metrics: list[Metric]) -> list[str]:
    """Return the row of a robot on the effect of noise on its best grasps."""
    tries = [trial for trial in tries if trial.best]
    share = np.array([trial.robustness for trial in tries])
    noisy_shares = np.array([trial.noisy for trial in tries])
    loads = np.array([trial.load for trial in tries])
    means = float(100 * share.mean()), float(100 * noisy_shares.mean())
    for key, value in zip(("robustness", "held_with_noise"), means, strict=True):
        name = f"touch_hold/{robot}/{key}"
        metrics.append(Metric(name, value, "%", "higher", math.nan, math.nan, len(tries)))
    areas = [f"{concordance(score, noisy_shares):.3f}" for score in (share, loads)]
    return [robot, *(f"{mean:.0f} %" for mean in means), *areas]


def concordance(scores: np.ndarray, values: np.ndarray) -> float:
    """Chance that of two with different values that of the larger one has the higher score."""
    larger = values[:, None] > values
    if not larger.any():
        return math.nan
    order = np.sign(scores[:, None] - scores)[larger]
    return float((order + 1).mean() / 2)


class Hold:
    """A grasp in MuJoCo: the hand's palm is fixed, fingers are held by springs, pads are balls."""

    def __init__(self, robot: ik.ArmHand, trial: FoundGrasp, surface: ik.Surface) -> None:
        self.robot, self.grasp, self.surface = robot, trial, surface
        description = robot.description
        self.palm = robot.links(trial.q)[description.palm_link]
        self.leads = self._leads()
        self.spec = self._spec()
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)
        self._free = int(self.model.jnt_qposadr[self.model.body("thing").jntadr[0]])

    def _leads(self) -> dict[int, dict[str, float]]:
        """Return the joints that each motor of the hand moves, with their ratios."""
        robot, q, joints_by_motor = self.robot, self.grasp.q, {}
        start = robot.joints(q)
        for motor in robot.description.hand_actuators:
            step = np.zeros(len(q))
            step[motor] = 1e-4 if q[motor] + 1e-4 <= robot.upper[motor] else -1e-4
            end = robot.joints(q + step)
            ratios = {name: (end[name] - start[name]) / step[motor] for name in start}
            joints_by_motor[motor] = {
                name: value for name, value in ratios.items() if abs(value) > 1e-6
            }
        return joints_by_motor

    def _spec(self) -> Any:
        robot, description = self.robot, self.robot.description
        spec = mujoco.MjSpec()
        spec.option.timestep = STEP
        spec.option.gravity = [0, 0, 0]
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        palm = spec.worldbody.add_body(name=description.palm_link, **_frame(self.palm))
        bodies = {description.palm_link: palm}
        joints = robot.joints(self.grasp.q)
        for joint in description.joints:
            if joint.parent not in bodies or joint.part != "hand":
                continue
            body = bodies[joint.parent].add_body(name=joint.child, **_frame(joint.placement))
            body.mass, body.inertia, body.explicitinertial = 0.02, [1e-5] * 3, True
            bodies[joint.child] = body
            if joint.type in ("revolute", "prismatic"):
                slide = joint.type == "prismatic"
                body.add_joint(
                    name=joint.name,
                    type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
                    axis=joint.axis,
                    armature=0.1 if slide else 1e-3,
                    damping=30.0 if slide else 0.15,
                )
        friction = [FRICTION, 2 / 3 * FRICTION * PATCH, 1e-4]
        look = {"friction": friction, "condim": 4, "solref": [0.004, 1.0]}
        for finger in description.fingers:
            point = finger.placement[:3, 3]
            normal = finger.placement[:3, :3] @ finger.normal
            radius = finger.radius or PAD
            bodies[finger.link].add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[radius, 0, 0],
                pos=point - radius * normal,
                mass=0.0,
                contype=1,
                conaffinity=2,
                **look,
            )
        pose = self.grasp.grasp.known_pose
        assert pose is not None
        body = spec.worldbody.add_body(name="thing", **_frame(pose))
        body.add_freejoint()
        solids = object_solids(self.surface.name)
        for i, (solid, pose) in enumerate(solids):
            points, _ = solid.mesh()
            mesh = spec.add_mesh(name=f"part_{i}", uservert=np.asarray(points, float).ravel())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=f"part_{i}",
                mass=MASS / len(solids),
                contype=2,
                conaffinity=1,
                **_frame(pose),
                **look,
            )
        kinds = {joint.name: joint.type for joint in description.joints}
        for motor, ratios in self.leads.items():
            ratios = {name: r for name, r in ratios.items() if spec.joint(name) is not None}
            if not ratios:
                continue
            lead = max(ratios, key=lambda name: abs(ratios[name]))
            stiff = STIFFNESS[kinds[lead]]
            spec.add_actuator(
                name=f"motor_{motor}",
                target=lead,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gainprm=[stiff, *[0] * 9],
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                biasprm=[0, -stiff, *[0] * 8],
            )
            for name, ratio in ratios.items():
                if name != lead:
                    a = ratio / ratios[lead]
                    spec.add_equality(
                        type=mujoco.mjtEq.mjEQ_JOINT,
                        name1=name,
                        name2=lead,
                        data=[joints[name] - a * joints[lead], a, *[0] * 9],
                        objtype=mujoco.mjtObj.mjOBJ_JOINT,
                    )
        return spec

    def targets(self) -> np.ndarray:
        """Return the targets of the springs for the desired forces of fingertips."""
        robot, q, model = self.robot, self.grasp.q, self.model
        joints, goals, contact_frames = robot.joints(q), np.zeros(model.nu), robot.contact_frames(q)
        pressed = []
        for name, force in self.grasp.forces.items():
            i, point = robot.fingers.index(name), self.grasp.grasp.contacts[name].point
            pressed.append((i, np.linalg.inv(contact_frames[i]) @ np.append(point, 1.0), force))
        for motor, ratios in self.leads.items():
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, f"motor_{motor}")
            if index < 0:
                continue
            step = np.zeros(len(q))
            step[motor] = 1e-5
            slope = (robot.contact_frames(q + step) - robot.contact_frames(q - step)) / 2e-5
            torque = SQUEEZE * sum(float((slope[i] @ at)[:3] @ force) for i, at, force in pressed)
            lead = model.joint(int(model.actuator_trnid[index, 0])).name
            stiff = model.actuator_gainprm[index, 0]
            goals[index] = joints[lead] + torque / ratios[lead] / stiff
        return goals

    def settled(self, offset: np.ndarray | None = None) -> np.ndarray:
        """Return the state in which the fingers grip the object.

        Args:
            offset: (4, 4) of the object from where it is thought to be; the hand is open then.
                None: it is there, and the fingers touch.
        """
        model, data, robot = self.model, self.data, self.robot
        mujoco.mj_resetData(model, data)
        q = self.grasp.q.copy()
        if offset is not None:
            pose = self.grasp.grasp.known_pose @ offset
            data.qpos[self._free : self._free + 3] = pose[:3, 3]
            data.qpos[self._free + 3 : self._free + 7] = _frame(pose)["quat"]
            pregrasp = self.grasp.pregrasp
            for name, value in {} if pregrasp is None else pregrasp.posture.items():
                q[robot.actuators.index(name)] = value
        for name, value in robot.joints(q).items():
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
            if index >= 0:
                data.qpos[model.jnt_qposadr[index]] = value
        goals = self.targets()
        begin = np.array([data.qpos[model.jnt_qposadr[j]] for j in model.actuator_trnid[:, 0]])
        steps = round(SETTLING / STEP)
        for i in range(steps):
            data.ctrl[:] = begin + min(1.0, 1.5 * (i + 1) / steps) * (goals - begin)
            mujoco.mj_step(model, data)
        state = np.zeros(mujoco.mj_stateSize(model, STATE_SPEC))
        mujoco.mj_getState(model, data, state, STATE_SPEC)
        return state

    def is_held(self, state: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return whether the object stays when pulled by its weight along directions (k, 3)."""
        model, data = self.model, self.data
        body = model.body("thing").id
        is_held = np.zeros(len(directions), dtype=bool)
        for k, direction in enumerate(directions):
            mujoco.mj_setState(model, data, state, STATE_SPEC)
            mujoco.mj_forward(model, data)
            start_position, turn = data.xipos[body].copy(), data.xmat[body].reshape(3, 3).copy()
            data.xfrc_applied[:] = 0.0
            data.xfrc_applied[body, :3] = MASS * GRAVITY * direction
            for i in range(round(TIME / STEP)):
                mujoco.mj_step(model, data)
                if (
                    i % 25 == 0
                    and np.linalg.norm(data.xipos[body] - start_position) > 5 * MAX_DISPLACEMENT
                ):
                    break
            cosine = (np.trace(turn.T @ data.xmat[body].reshape(3, 3)) - 1) / 2
            rotation = np.arccos(np.clip(cosine, -1, 1))
            is_held[k] = (
                np.linalg.norm(data.xipos[body] - start_position) < MAX_DISPLACEMENT
                and rotation < MAX_ROTATION
            )
        return is_held


def _frame(pose: np.ndarray) -> dict[str, Any]:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(pose[:3, :3]).ravel())
    return {"pos": pose[:3, 3], "quat": quat}


if __name__ == "__main__":
    program(main)
