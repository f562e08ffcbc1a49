"""Exported solvers in single precision: nothing is double, and what they solve is solved."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import main

import casadi_ik as ik
from casadi_ik.exporting.project import c_project, write_folder
from casadi_ik.exporting.single import ROUNDING, SinglePrecision, in_single_precision
from casadi_ik.kernels.codegen import driver_text

STRICT = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wdouble-promotion", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")

LAST_PLACES = """
#include <stdio.h>
static double off(float found, double right) {
  const float near = fabsf((float) right);
  return fabs((double) found - right) / (double) (nextafterf(near, INFINITY) - near);
}
int main(void) {
  double worst[4] = {0};
  int i, k;
  for (i = 1; i < 200000; ++i) {
    const float x = (float) i * (i % 2 ? 1e-4f : -4e-2f), y = (float) (i % 997 - 498) * 1e-2f;
    const float part = (float) i / 200001.0f;
    const double all[] = {off(own_sin(x), sin((double) x)), off(own_cos(x), cos((double) x)),
                          off(own_atan2(y, x), atan2((double) y, (double) x)),
                          off(own_acos(part), acos((double) part))};
    /* Beside a zero the last place is smaller than the rounding of pi. */
    if (fabs(sin((double) x)) < 1e-2 || fabs(cos((double) x)) < 1e-2) continue;
    for (k = 0; k < 4; ++k) worst[k] = all[k] > worst[k] ? all[k] : worst[k];
  }
  printf("%g %g %g %g\\n", worst[0], worst[1], worst[2], worst[3]);
  printf("%g %g %g\\n", (double) own_atan2(0.0f, 0.0f), (double) own_atan2(-0.0f, -1.0f),
         (double) own_sin(1e6f));
  return 0;
}
"""


def compiled(place: Path, *words: str) -> None:
    done = subprocess.run(["gcc", *words], cwd=place, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:2000]


@pytest.mark.parametrize(
    ("double", "single"),
    [
        ("double x = 2. * a1 + .5e-3;", "float x = 2.f * a1 + .5e-3f;"),
        ("y = sqrt(fmax(x, 1e-300));", "y = sqrtf(fmaxf(x, 1.1754943508222875e-38f));"),
        ("far = 1e300, near = 0.0;", "far = 3.4028234663852886e+38f, near = 0.0f;"),
        ("i = 7 + 0x1e5 + n1e3; /* 1.0 double */", "i = 7 + 0x1e5 + n1e3; /* 1.0 double */"),
        ('#include "arm.h"\nprintf("double 1.5");', '#include "arm.h"\nprintf("double 1.5");'),
        ("own_sqrt(x) + 1.5f", "own_sqrt(x) + 1.5f"),
    ],
)
def test_c_in_single_precision(double, single):
    assert in_single_precision(double) == single
    assert in_single_precision(single) == single


def test_limits_are_moved_inwards(robot):
    lower, upper = SinglePrecision(robot).bounds
    for bounds in (lower, upper):
        assert np.array_equal(bounds, bounds.astype(np.float32))
    inside = np.minimum(lower - robot.lower, robot.upper - upper)
    assert (inside > 0.5 * ROUNDING).all()
    assert (inside < 5 * ROUNDING).all()


@needs_gcc
def test_sines_and_arcs_to_their_last_places(tmp_path):
    (tmp_path / "places.c").write_text(driver_text("elementary_single") + LAST_PLACES)
    compiled(tmp_path, *STRICT, "-O1", "-ffp-contract=off", "places.c", "-o", "places", "-lm")
    said = subprocess.run([tmp_path / "places"], capture_output=True, text=True, check=True).stdout
    worst, special = (list(map(float, line.split())) for line in said.splitlines())
    assert max(worst[:2]) < 2
    assert max(worst[2:]) < 4
    assert special == pytest.approx([0.0, -np.pi, np.sin(1e6)], abs=1e-5)


@pytest.fixture(scope="module")
def project(robot: ik.ArmHand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of the shipped robot, with a scene."""
    out = tmp_path_factory.mktemp("single") / "solver"
    write_folder(out, c_project(robot, "arm", 8, single=True))
    return out


def test_nothing_is_double(project):
    for path in (*project.glob("src/*"), *project.glob("include/*")):
        text = path.read_text()
        assert not re.search(r"\bdouble\b", re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.S))
        assert in_single_precision(text) == text


@needs_gcc
def test_what_it_solves_is_solved_in_double_precision(project):
    """By its own test, under sanitizers; the long generated file without, which takes as long."""
    rest = [f"src/{path.name}" for path in project.glob("src/*.c") if "_solve.c" not in path.name]
    places = ("-Iinclude", "-Isrc", "-Itest", "-ffp-contract=off")
    compiled(project, *STRICT, *places, "-O0", "-c", "src/arm_solve.c")
    tests = ("test/test.c", "test/judge.c")
    command = (*STRICT, *SANITIZERS, *places, "-O0", *tests, *rest, "arm_solve.o")
    compiled(project, *command, "-lm", "-o", "stored")
    done = subprocess.run([project / "stored"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    solved, wanted = re.findall(r"(\d+) solved of (\d+) that", done.stdout)[0]
    assert int(wanted) == 401
    assert int(solved) >= int(wanted)
    assert ", 0 missed, " in done.stdout
    assert "wrong: 0" in done.stdout

    for program in ("example/main.c", "bench/bench.c"):
        compiled(project, *STRICT, "-Iinclude", "-fsyntax-only", program)


def test_webassembly_has_doubles(tmp_path, capsys):
    words = ["export", "kuka_lwr_barrett", "--out", str(tmp_path / "s"), "--single"]
    assert main([*words, "--target", "wasm"]) == 2
    assert "--single: WebAssembly computes as fast in double precision" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
