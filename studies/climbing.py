"""A search that climbs towards reachable targets which take long, or are missed.

Many climbers walk over all configurations within limits. A step moves some of a climber's motors,
a little or far, or puts them at a limit; the contacts of where it leads are solved at all
tolerances, and the climber stays there if that took more iterations (half of them: if it also made
the contacts tell less about the motors, by the smallest singular value). Who has not risen for a
while begins anew, somewhere at random or next to the hardest target so far.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from runner.parts import code_version, keep
from samplers import contact_slopes, corners

import casadi_ik as ik
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array

CLIMBERS = 512
PATIENCE = 25
"""Steps without a rise before a climber begins anew."""

TURN = 20.0
"""Seconds after which a search is written to its file."""

CONDITION = 0.3
"""Weight of the logarithm of the smallest singular value, against that of iterations."""


@dataclass
class Search:
    """The climbers of one robot, and what they have come upon.

    Attributes:
        q: (CLIMBERS, n) where they are.
        score: (CLIMBERS,) how hard that is.
        waited: (CLIMBERS,) steps since the last rise.
        seconds: Spent so far.
        total: Targets solved at each tolerance.
        hardest_by_tolerance: Most iterations and restarts, by tolerance.
        missed: "tolerance", "status" and "q" of each miss.
    """

    q: Array
    score: Array
    waited: Array
    seconds: float = 0.0
    total: int = 0
    hardest_by_tolerance: dict[str, list[int]] = field(default_factory=dict)
    missed: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def begun(cls, robot: ik.ArmHand, rng: np.random.Generator) -> Search:
        """Climbers at random, half of them with motors at limits."""
        q = np.concatenate([robot.random(rng, CLIMBERS // 2), corners(robot, rng, CLIMBERS // 2)])
        return cls(q, np.full(CLIMBERS, -np.inf), np.zeros(CLIMBERS))

    def step(self, solvers: dict[str, ik.Solver], rng: np.random.Generator) -> None:
        """Advance every climber by one step."""
        robot = next(iter(solvers.values())).robot
        q = _random_steps(robot, self.q, rng)
        points, normals = robot.contacts(q)
        iterations, missed = np.zeros(CLIMBERS), np.zeros(CLIMBERS, dtype=bool)
        for name, solver in solvers.items():
            batch = solver.solve_batch(points, normals)
            iterations += batch.iterations
            largest = self.hardest_by_tolerance.setdefault(name, [0, 0])
            largest[0] = max(largest[0], int(batch.iterations.max()))
            largest[1] = max(largest[1], int(batch.restarts.max()))
            for row in np.flatnonzero(~batch.success):
                missed[row] = True
                status = str(batch.status_names[row])
                self.missed.append({"tolerance": name, "status": status, "q": q[row].tolist()})
        self.total += CLIMBERS
        score = np.log(iterations)
        even_rows = slice(0, None, 2)
        score[even_rows] -= CONDITION * np.log10(contact_slopes(robot, q[even_rows]) + 1e-16)
        better = (score >= self.score) & ~missed
        self.waited = np.where(score > self.score, 0.0, self.waited + 1)
        self.q[better], self.score[better] = q[better], score[better]
        # What is missed is known by then: the search goes on elsewhere.
        restarted = np.flatnonzero(missed | (self.waited > PATIENCE))
        hardest = self.q[rng.permutation(np.argsort(self.score)[-CLIMBERS // 8 :])]
        parents = hardest[rng.integers(0, len(hardest), len(restarted))]
        fresh = rng.random((len(restarted), 1)) < 0.5
        self.q[restarted] = np.where(fresh, robot.random(rng, len(restarted)), parents)
        self.score[restarted], self.waited[restarted] = -np.inf, 0.0


def climb(solvers: dict[str, ik.Solver], path: Path, seconds: float, seed: int) -> dict[str, Any]:
    """Search until so much time was spent in all, going on with the search of a file.

    Args:
        solvers: Of one robot, by name of their tolerance.
        path: File of the search's state, written every now and then.
        seconds: How long, in all runs together [s].
        seed: Of everything random.

    Returns:
        The fields of the `Search` but its climbers, and "code".

    Raises:
        InputError: The file is of another seed or of other code.
    """
    robot = next(iter(solvers.values())).robot
    rng = np.random.default_rng([seed, len(robot.name), *robot.name.encode()])
    search, identity = Search.begun(robot, rng), {"code": code_version(), "seed": seed}
    if path.exists():
        stored = json.loads(path.read_text(encoding="utf-8"))
        if identity != {name: stored[name] for name in identity}:
            raise InputError(f"{path}: made by other code or with another seed; use another folder")
        rng.bit_generator.state = stored["rng"]
        arrays = {name: np.array(stored["search"][name]) for name in ("q", "score", "waited")}
        search = Search(**(stored["search"] | arrays))
    while search.seconds < seconds:
        begun = time.monotonic()
        left = min(TURN, seconds - search.seconds)
        while (elapsed := time.monotonic() - begun) < left:
            search.step(solvers, rng)
        search.seconds += elapsed
        data = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(search).items()}
        state = identity | {"rng": rng.bit_generator.state, "search": data}
        keep(path, json.dumps(state, default=float))
        hardest = max(iterations for iterations, _ in search.hardest_by_tolerance.values())
        text = f"{search.total:,} targets, {len(search.missed)} missed, hardest {hardest:,}"
        print(f"{robot.name}: {search.seconds:.0f} s, {text} iterations", file=sys.stderr)
    return read_search(path)


def read_search(path: Path) -> dict[str, Any]:
    """Return the stored state of a search (see `climb`)."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    return stored["search"] | {"code": stored["code"]}


def _random_steps(robot: ik.ArmHand, q: Array, rng: np.random.Generator) -> Array:
    """Return random steps from configurations (k, n), some of them to a limit."""
    ranges = robot.upper - robot.lower
    size = 10.0 ** rng.uniform(-4, 0, (len(q), 1))
    is_changed = rng.random(q.shape) < rng.uniform(0.1, 1, (len(q), 1))
    perturbed = q + np.where(is_changed, rng.normal(0, 1, q.shape) * size * ranges, 0.0)
    snapped = rng.random(q.shape) < 0.05
    ends = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    return np.clip(np.where(snapped, ends, perturbed), robot.lower, robot.upper)
