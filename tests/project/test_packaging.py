"""Installed files, extras and imports."""

from __future__ import annotations

import ast
import re
import tomllib

import pytest
import yaml
from processes import ROOT, python

import casadi_ik as ik

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ON_DEMAND = "pinocchio coal matplotlib pyvista polars mujoco scipy proxsuite trimesh collada rich"
"""Packages that the public names do not import."""


def test_version_is_stated_once():
    assert PROJECT["dynamic"] == ["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == ik.__version__


def test_the_core_is_light():
    names = [line.split(">")[0].split(";")[0] for line in PROJECT["dependencies"]]
    assert not {"pin", "matplotlib", "pyvista", "polars", "scipy", "trimesh"} & set(names)
    assert len(names) <= 8
    assert len(PROJECT["optional-dependencies"]) <= 8


def test_modules_belong_to_the_extra_that_errors_name():
    extras = PROJECT["optional-dependencies"]
    packages = {"collada": "pycollada", "foxglove": "foxglove-sdk", "pinocchio": "pin"}
    for module, extra in ik.errors.EXTRA_OF_MODULE.items():
        package = packages.get(module, module).removesuffix("modules")
        assert any(line.startswith(f"{package}>=") for line in extras[extra]), module


CORE_ONLY = """
import sys
for name in {modules!r}:
    sys.modules[name] = None
import casadi_ik as ik
scene = ik.load_scene("table")
solver = ik.Solver(ik.load_robot("kuka_lwr_barrett"), scene=scene)
assert solver.solve(ik.load_grasp("cup"), log={log!r}).success
assert len(ik.logs.open({log!r}).solves()) == 1
try:
    ik.load_surface({mesh!r})
except ik.errors.MissingExtraError as error:
    print(error)
"""


def test_the_core_solves_and_logs_without_extras(tmp_path):
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    modules = [*ik.errors.EXTRA_OF_MODULE, "polars", "joblib", "dask"]
    modules.remove("ziglang")
    program = CORE_ONLY.format(modules=modules, log=str(tmp_path / "a.mcap"), mesh=str(mesh))
    done = python("-c", program)
    assert done.returncode == 0, done
    assert "pip install 'casadi-ik[meshes]'" in done.stdout


@pytest.mark.parametrize(
    "program", ["import casadi_ik", "import casadi_ik as ik; ik.Solver; ik.load_robot('ar10')"]
)
def test_imported_modules(program):
    script_end = f"; import sys; print(*(x for x in {ON_DEMAND!r}.split() if x in sys.modules))"
    done = python("-c", program + script_end)
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
    content = yaml.safe_load(path.read_text())
    for job in content.get("jobs", {}).values():
        assert {"runs-on", "steps"} <= job.keys()


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda p: p.stem)
def test_workflows_name_existing_files(path):
    for name in re.findall(r"(?<![\w/.])(?:tests|tools|studies)/[\w/]+(?:\.py)?", path.read_text()):
        assert (ROOT / name).exists(), name


def test_the_recipe_has_the_dependencies_of_the_core():
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    run = recipe["requirements"]["run"]
    bounds = sorted(line.rpartition(" ")[2] for line in run if not line.startswith("python >"))
    assert bounds == sorted(">=" + line.split(">=")[1] for line in PROJECT["dependencies"])
    assert recipe["context"]["version"] == ik.__version__


POSIX_MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios"}
POSIX_CALLS = {"chown", "fork", "geteuid", "getuid", "killpg", "mkfifo", "SIGKILL"}


@pytest.mark.parametrize("folder", ["casadi_ik", "tests", "studies", "tools"])
def test_modules_can_be_imported_on_windows(folder):
    """Code outside functions imports and calls only names of all platforms."""
    for path in (ROOT / folder).rglob("*.py"):
        pending = list(ast.parse(path.read_text(encoding="utf-8")).body)
        for node in pending:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.Try):
                continue
            if isinstance(node, ast.BoolOp):  # `os.name != "posix" or os.geteuid() == 0`
                continue
            names = {alias.name for alias in getattr(node, "names", ())}
            assert not isinstance(node, ast.Import) or not names & POSIX_MODULES, path
            assert not isinstance(node, ast.Attribute) or node.attr not in POSIX_CALLS, path
            pending += ast.iter_child_nodes(node)
