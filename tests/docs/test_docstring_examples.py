"""Every public name has an example in its docstring, and all examples pass."""

from __future__ import annotations

import doctest
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import casadi_ik as ik

SUBMODULES = tuple(name for name in ik.__all__ if inspect.ismodule(getattr(ik, name)))
WITHOUT_EXAMPLE = {
    "METHODS",  # a tuple of names
    *SUBMODULES,  # their names have their own
    "logs.Compression",  # three words
    "logs.detect_events",  # takes what a recorder is given while a batch runs
}
METHODS_TOO = ("ArmHand", "Solver", "Grasp", "Contact", "Scene", "papers.ScrewControl", "logs.Log")
"""Classes of which every method has an example of its own, and their exceptions."""
PLAIN = {
    "ArmHand.configuration",  # checks and copies
    "ArmHand.frames_at",  # contact_frames without checks
    "ArmHand.beyond_limits",  # three numbers as errors has them
    "ArmHand.deviations",
    "ArmHand.toggle_margins",
    "Contact.at",  # deprecated
    "Grasp.more",  # deprecated
    "ArmHand.view",  # a server and a browser; tests/viewing has them
    "papers.ScrewControl.stepper",  # as Solver.stepper
    "logs.Log.attachment",
    "logs.Log.sources",
}


def public_names() -> list[str]:
    submodules = (
        f"{module}.{name}"
        for module in SUBMODULES
        if module != "errors"
        for name in getattr(ik, module).__all__
    )
    return [*ik.__all__, *submodules]


def public_object(name: str) -> Any:
    value: Any = ik
    for part in name.split("."):
        module = inspect.ismodule(value)
        value = getattr(value, part) if module else inspect.getattr_static(value, part)
    return value


def methods_of(name: str) -> list[str]:
    """Return the public methods of a class, including inherited ones."""
    value = public_object(name)
    return [
        f"{name}.{attribute}"
        for attribute in dir(value)
        if not attribute.startswith("_")
        and inspect.isfunction(inspect.getattr_static(value, attribute))
    ]


def documented() -> list[str]:
    return public_names() + [
        method
        for name in public_names()
        if inspect.isclass(public_object(name)) and not issubclass(public_object(name), (str, int))
        for method in methods_of(name)
    ]


def text_of(name: str) -> str:
    return inspect.getdoc(public_object(name)) or ""


def test_every_public_name_has_an_example() -> None:
    names = [*public_names(), *(method for name in METHODS_TOO for method in methods_of(name))]
    lacking = [
        name for name in names if name not in WITHOUT_EXAMPLE | PLAIN and ">>>" not in text_of(name)
    ]
    assert not lacking
    assert all(">>>" not in text_of(name) for name in PLAIN), "has one after all"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("examples")


@pytest.fixture(scope="module")
def names(folder: Path) -> dict[str, Any]:
    """Objects that the examples use without defining them, as on the API page."""
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    solver = ik.Solver(robot)
    offset_pose = np.eye(4)
    offset_pose[0, 3] = -1.0
    (folder / "hand.yaml").write_text("fingers: {thumb: 4, finger_2: 8, finger_3: 12}")
    return {
        "ik": ik,
        "np": np,
        "Path": Path,
        "robot": robot,
        "solver": solver,
        "grasp": grasp,
        "solution": solver.solve(grasp, log=folder / "cup.mcap"),
        "far": solver.solve(grasp.at(offset_pose)),
        "keypoints": 0.05 * np.random.default_rng(0).normal(size=(21, 3)),
    }


@pytest.mark.slow
def test_examples(names: dict[str, Any], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(ik.solve.registry, "_ENTRIES", dict(ik.solve.registry._ENTRIES))
    parser = doctest.DocTestParser()
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for name in documented():
        example = parser.get_doctest(text_of(name), dict(names), name, None, 0)
        runner.run(example, out=report.append, clear_globs=False)
    assert runner.tries > 140
    assert runner.failures == 0, "".join(report)
