"""The recorder that a solver writes to: a new log's, or one that is open already."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from os import PathLike
from typing import Any, Protocol

from casadi_ik.answers.recorder import Recorder
from casadi_ik.arm_hand import ArmHand
from casadi_ik.logs.write.keep import Keep
from casadi_ik.logs.write.recorder import Compression, McapRecorder


class Described(Protocol):
    """What a log says of a solver."""

    robot: ArmHand

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Everything that determines a solve but target, start and seed."""
        ...


def recorder_of(
    solver: Described,
    log: str | PathLike[str] | Recorder | None,
    seed: int,
    keep: Keep | None = None,
    compression: Compression = "zstd",
) -> AbstractContextManager[Recorder | None]:
    """A recorder for a path, closed in the end; an open one, or None, as it is.

    Raises:
        LogError: The log cannot be written.
    """
    if not isinstance(log, str | PathLike):
        return nullcontext(log)
    return McapRecorder(
        log,
        robot_name=solver.robot.name,
        urdf=solver.robot.urdf(),
        parameters=dict(solver.parameters),
        seed=seed,
        keep=keep,
        compression=compression,
    )
