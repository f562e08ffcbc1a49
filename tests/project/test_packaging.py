"""What is installed, and what it imports."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
import yaml
from processes import python

import casadi_ik as ik

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ON_DEMAND = "pinocchio coal matplotlib pyvista polars mujoco scipy proxsuite trimesh collada rich"
"""What the public names do not import."""


def test_version_is_said_once():
    assert PROJECT["dynamic"] == ["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == ik.__version__


def test_the_core_asks_for_no_second_opinion():
    names = [line.split(">")[0].split(";")[0] for line in PROJECT["dependencies"]]
    assert not {"pin", "matplotlib", "pyvista", "polars"} & set(names)
    assert any(line.startswith("pin>") for line in PROJECT["optional-dependencies"]["reference"])


@pytest.mark.parametrize(
    "program", ["import casadi_ik", "import casadi_ik as ik; ik.Solver; ik.load_robot('ar10')"]
)
def test_what_is_imported(program):
    more = f"; import sys; print(*(x for x in {ON_DEMAND!r}.split() if x in sys.modules))"
    done = python("-c", program + more)
    assert (done.stdout.strip(), done.stderr, done.returncode) == ("", "", 0)


def test_the_oldest_dependencies_are_the_lower_bounds():
    lines = (ROOT / "oldest.txt").read_text().splitlines()
    oldest = dict(line.split("==") for line in lines if not line.startswith("#"))
    bounds = dict(line.split(">=") for line in PROJECT["dependencies"])
    assert oldest.keys() == bounds.keys()
    for name, bound in bounds.items():
        assert f"{oldest[name]}.".startswith(f"{bound}.")


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda p: p.stem)
def test_workflows_and_forms_are_yaml(path):
    found = yaml.safe_load(path.read_text())
    for job in found.get("jobs", {}).values():
        assert {"runs-on", "steps"} <= job.keys()


def test_the_recipe_has_the_dependencies_of_the_core():
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    run = recipe["requirements"]["run"]
    bounds = sorted(line.rpartition(" ")[2] for line in run if not line.startswith("python >"))
    assert bounds == sorted(">=" + line.split(">=")[1] for line in PROJECT["dependencies"])
    assert recipe["context"]["version"] == ik.__version__
