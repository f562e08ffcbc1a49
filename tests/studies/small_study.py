"""Study of a few targets for the tests, which can also be run as a program."""

from __future__ import annotations

import sys
from pathlib import Path

from runner.report import program
from runner.study import Setting, Study, TargetSet, run
from samplers import near_limits, random_hands

import casadi_ik as ik

CHANGED = Setting("loose", "hand-first", tolerance=(2e-3, 0.05))
STUDY = Study(
    "small",
    "kuka_lwr_barrett",
    (TargetSet("random hands", random_hands), TargetSet("near limits", near_limits)),
    (Setting("loose", "hand-first"), Setting("exact", "hand-first", tolerance=(1e-6, 1e-6))),
    count=40,
    block=4,
)


def main() -> None:
    """Run the study: FOLDER [ADDRESS of a Dask scheduler]."""
    address = sys.argv[2] if len(sys.argv) > 2 else None
    run(STUDY, Path(sys.argv[1]), jobs=2, dask=address, log=ik.logs.Keep())


if __name__ == "__main__":
    program(main)
