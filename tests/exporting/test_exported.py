"""Exported solvers compile without warnings, give identical bits, and define no other symbols."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from c_flags import SANITIZERS, STRICT
from commands import main
from processes import output_of

import casadi_ik as ik
from casadi_ik.compile.codegen import driver_text
from casadi_ik.export.project import EXPORT_MARKER, c_project, export_prefix, write_folder
from casadi_ik.export.single import SINGLE_ROUNDING, SinglePrecision, in_single_precision
from casadi_ik.export.solver import sanitized_name
from casadi_ik.export.targets import SceneTargets, stored_targets

LIBM = {"sin", "cos", "sincos", "pow", "fmod", "fmax", "fmin", "rint", "sqrt", "floor", "hypot"}
LIBM |= {"frexp", "ldexp"}
COMPILERS = {"memcpy", "memset", "memcmp", "memmove", "_GLOBAL_OFFSET_TABLE_"}
"""Functions that a C compiler may call by itself, also without a C library."""

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")


@pytest.fixture(scope="module")
def project(robot, tmp_path_factory) -> Path:
    """Project of the shipped robot with a scene."""
    out = tmp_path_factory.mktemp("exported") / "solver"
    write_folder(out, c_project(robot, "arm", 8))
    return out


@pytest.fixture(scope="module")
def plain_project(tmp_path_factory) -> Path:
    """Project of a hand without a scene."""
    out = tmp_path_factory.mktemp("exported") / "hand"
    write_folder(out, c_project(ik.load_robot("ar10"), "arm"))
    return out


def compiled(project: Path, *flags: str) -> None:
    output_of("gcc", *STRICT, *flags, "-Iinclude", "-Isrc", "-Itest", cwd=project)


@pytest.mark.slow
@needs_gcc
def test_stored_targets_bit_for_bit_under_sanitizers(project):
    sources = [str(path.relative_to(project)) for path in sorted(project.glob("src/*.c"))]
    # The long generated file is plain arithmetic: to look for undefined behaviour in it, too, takes
    # as long as all the rest.
    long = "src/arm_solve.c"
    compiled(project, "-O0", "-fsanitize=address", "-c", long)
    compiled(project, "-O0", *SANITIZERS, "-c", *(name for name in sources if name != long))
    objects = [Path(name).with_suffix(".o").name for name in sources]
    for program, text in (("stored", "test/test.c"), ("shown", "example/main.c")):
        compiled(project, *SANITIZERS, text, *objects, "-o", program, "-lm")
    assert "1000 targets, 402 solved" in output_of(project / "stored")
    assert "solved after" in output_of(project / "shown")
    listed = output_of("nm", "-u", "-P", *objects, cwd=project).splitlines()
    undefined = {line.split()[0] for line in listed if line.endswith(" U") or " U " in line}
    foreign = {name for name in undefined if not name.startswith(("arm_", "__asan", "__ubsan"))}
    assert "sin" in foreign
    assert foreign <= LIBM | COMPILERS


IN_A_SCENE = """
#include <stdio.h>
#include "arm.h"
static arm_solver solver;
int main(void) { /* pose of a box; rows of numbers: whether there is a q0, points, normals, q0 */
  const double size[] = {0.3, 0.3, 0.2};
  double pose[12], row[1 + 6 * ARM_FINGERS + ARM_MOTORS];
  arm_init(&solver);
  if (fread(pose, sizeof pose, 1, stdin) != 1) return 2;
  arm_set_solid(&solver, 0, ARM_BOX, size, pose, 0);
  while (fread(row, sizeof row, 1, stdin) == 1) {
    const double *points = row + 1, *normals = points + 3 * ARM_FINGERS;
    int i;
    printf("%d", arm_solve(&solver, points, normals, *row ? normals + 3 * ARM_FINGERS : 0));
    printf(" %a", solver.clearance);
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", solver.q[i]);
    puts("");
  }
  return 0;
}
"""


@pytest.mark.slow
@needs_gcc
@pytest.mark.parametrize("name", ["two_ur10e+barrett_bh8_280", "mobile_kuka_lwr_barrett"])
def test_exported_body_keeps_clear_of_scene_and_itself(tmp_path, name):
    """Return targets of collision-free postures; every third has an idle finger."""
    robot = ik.load_robot(name)
    write_folder(tmp_path, c_project(robot, "arm", 2))
    (tmp_path / "scene.c").write_text(IN_A_SCENE)
    sources = [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.glob("src/*.c"))]
    compiled(tmp_path, "-O1", "-c", *sources)
    objects = [Path(name).with_suffix(".o").name for name in sources]
    for program, text in (("stored", "test/test.c"), ("answers", "scene.c")):
        compiled(tmp_path, text, *objects, "-o", program, "-lm")
    assert "wrong: 0" in output_of(tmp_path / "stored")

    place = [0.5, 0.2, 0.6]
    scene = ik.Scene({"box": {"kind": "box", "size": [0.3, 0.3, 0.2], "xyz": place}})
    solver, samples = ik.Solver(robot, scene=scene), robot.random(np.random.default_rng(2), 3000)
    any_grasp = ik.Grasp({robot.fingers[0]: ik.Contact([0.5, 0.0, 0.5])})

    def clear(q):
        verdicts = solver.check(q, any_grasp)
        assert verdicts is not None
        return verdicts

    q = samples[clear(samples).free][:60]
    (points, normals), count = robot.contacts(q), len(q)
    points[::3, 0] = normals[::3, 0] = np.nan
    is_near = np.arange(count) % 4 == 1
    rows = np.hstack(
        [is_near[:, None], *(a.reshape(count, -1) for a in (points, normals, q + 0.01))]
    )
    payload = np.array([*np.eye(3).ravel(), *place]).tobytes() + rows.tobytes()
    lines = [line.split() for line in output_of(tmp_path / "answers", input=payload).splitlines()]
    distances = np.array([[float.fromhex(word) for word in words[1:]] for words in lines])
    assert {words[0] for words in lines} == {str(int(ik.Status.SOLVED))}
    answers, clearance = distances[:, 1:], clear(distances[:, 1:])
    assert clearance.free.all()
    assert np.allclose(clearance.distance, distances[:, 0], atol=1e-9)
    offsets = np.linalg.norm(robot.contacts(answers)[0] - points, axis=2)
    assert np.nanmax(offsets) < 5.001e-3
    assert np.isnan(offsets).sum() == len(points[::3])
    # Otherwise nothing was checked.
    first = ik.Solver(robot).solve_batch(points, normals).q
    assert (~clear(first).free).sum() > 10


@pytest.mark.slow
@needs_gcc
def test_exported_body_has_sides_and_trunk(tmp_path):
    """A G1 compiles without a warning, and the hands of each side are in a file of their own."""
    write_folder(tmp_path, c_project(ik.load_robot("g1+dex3"), "g1"))
    assert (tmp_path / "src" / "g1_side_0.c").is_file()
    assert (tmp_path / "src" / "g1_side_1.c").is_file()
    sources = [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.glob("src/*.c"))]
    compiled(tmp_path, "-O0", *sources, "test/test.c", "-o", "stored", "-lm")
    assert "wrong: 0" in output_of(tmp_path / "stored")


WINE = shutil.which("wine64") or shutil.which("wine64", path="/usr/lib/wine")


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="needs ziglang")
@pytest.mark.parametrize(
    ("target", "program", "runner"),
    [
        ("aarch64-linux-musl", "stored", shutil.which("qemu-aarch64")),
        ("x86_64-windows-gnu", "stored.exe", WINE),
    ],
)
def test_stored_targets_bit_for_bit_on_other_machines(
    plain_project, tmp_path, target, program, runner
):
    """Emulators run exports for other platforms: apt-get install qemu-user, wine64."""
    if runner is None:
        pytest.skip("no emulator")
    sources = [*sorted(plain_project.glob("src/*.c")), plain_project / "test" / "test.c"]
    folders = [f"-I{plain_project / name}" for name in ("include", "src", "test")]
    command = [sys.executable, "-m", "ziglang", "cc", "-target", target, "-std=c11", "-O1"]
    command += ["-ffp-contract=off", "-fno-sanitize=all", *folders, *map(str, sources)]
    executable = tmp_path / program
    output_of(*command, "-o", executable, "-lm")
    wine_options = {"WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all"}
    output = output_of(runner, executable, env=os.environ | wine_options)
    assert "1000 targets" in output
    assert "wrong: 0" in output


@pytest.mark.slow
def test_exported_arms_avoid_the_scene(robot):
    """Otherwise the comparison of stored answers would not test the choice among arms."""
    solver = ik.Solver(robot)
    targets = SceneTargets(solver, 8)
    q_before = stored_targets(solver)[:200]
    after = [targets.with_scene_result(target) for target in q_before]
    differs = [b["q"] != a["q"] for b, a in zip(q_before, after, strict=True)]
    assert sum(differs) > 20
    ends = {ik.Status(target["status"]).name for target in after}
    assert {"SOLVED", "COLLISION"} <= ends


QUERY_PROGRAM = """
#include <stdio.h>
#include "arm.h"
static arm_solver solver;
int main(void) { /* rows of numbers: whether there is a q0, points, normals, q0 */
  double row[1 + 6 * ARM_FINGERS + ARM_MOTORS];
  arm_init(&solver);
  while (fread(row, sizeof row, 1, stdin) == 1) {
    const double *points = row + 1, *normals = points + 3 * ARM_FINGERS;
    const double *q0 = normals + 3 * ARM_FINGERS;
    int i;
    printf("%d", arm_solve(&solver, points, normals, *row ? q0 : 0));
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", solver.q[i]);
    puts("");
  }
  return 0;
}
"""
ODD = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-320, 1e-200, 1e-99, 1e30, 1e101, 1e200, 1.7e308)


def malformed(robot: ik.ArmHand, count: int) -> tuple[np.ndarray, ...]:
    """Return targets of which most have a non-finite or huge number, or invalid free vectors."""
    rng = np.random.default_rng(0)
    q = robot.random(rng, count)
    (points, normals), q0 = robot.contacts(q), q + 0.01
    for row in range(count):
        for _ in range(rng.integers(3)):
            array = (points, normals, q0[:, None])[rng.integers(3)]
            vector = array[row, rng.integers(array.shape[1])]
            odd, is_whole_vector = rng.choice(ODD), rng.random() < 0.8
            # Most of the others are out of reach, which takes long.
            index = (
                slice(None) if is_whole_vector or np.isfinite(odd) else rng.integers(len(vector))
            )
            vector[index] = odd * (vector[index] if array is normals or rng.random() < 0.2 else 1.0)
    return points, normals, q0, rng.random(count) < 0.5


@needs_gcc
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid")
def test_malformed_targets_have_the_same_status_as_in_python(plain_project):
    """Inputs that Python refuses are bad inputs in C; other statuses and configurations agree."""
    robot, count = ik.load_robot("ar10"), 1500
    (plain_project / "asked.c").write_text(QUERY_PROGRAM)
    sources = [str(path.relative_to(plain_project)) for path in plain_project.glob("src/*.c")]
    compiled(plain_project, "-O1", "asked.c", *sources, "-o", "asked", "-lm")
    points, normals, q0, has_q0 = malformed(robot, count)
    rows = np.hstack([has_q0[:, None], *(a.reshape(count, -1) for a in (points, normals, q0))])
    lines = output_of(plain_project / "asked", input=rows.tobytes()).splitlines()
    outputs = [line.split() for line in lines]
    fast, refused, ends = ik.Solver(robot).fast(), 0, set()
    for row in range(count):
        status, *words = outputs[row]
        target = points[row], normals[row], q0[row] if has_q0[row] else None
        if status == "-2":
            with pytest.raises(ik.errors.InputError):
                fast(*target)
            refused += 1
            continue
        q, ended = fast(*target)
        assert int(status) == ended, row
        np.testing.assert_array_equal(q, [float.fromhex(word) for word in words], f"row {row}")
        ends.add(ended.name)
    assert 200 < refused < 1300
    assert {"SOLVED", "STALLED", "INVALID"} <= ends


GRASPED = """
#include <stdio.h>
#include "arm.h"
static arm_solver solver;
int main(void) { /* how many solids, each: kind, size, pose; points, normals */
  double count, solid[16], row[6 * ARM_FINGERS];
  while (fread(&count, sizeof count, 1, stdin) == 1) {
    int i;
    arm_init(&solver);
    for (i = 0; i < (int) count; ++i) {
      if (fread(solid, sizeof solid, 1, stdin) != 1) return 2;
      if (arm_set_solid(&solver, i, (int) solid[0], solid + 1, solid + 4, 1)) return 2;
    }
    if (fread(row, sizeof row, 1, stdin) != 1) return 2;
    printf("%d", arm_solve(&solver, row, row + 3 * ARM_FINGERS, 0));
    for (i = 0; i < ARM_MOTORS; ++i) printf(" %a", solver.q[i]);
    puts("");
  }
  return 0;
}
"""


@pytest.mark.slow
@needs_gcc
def test_other_hands_match_python(tmp_path):
    """For grasps of the page with the object in the hand, C and Python find the same collisions."""
    page = runpy.run_path(str(Path(__file__).parents[2] / "page" / "build.py"))
    robot, out = ik.load_robot("panda+shadow"), tmp_path / "solver"
    words = ["export", "panda+shadow", "--prefix", "arm", "--scene", "8", "--out", str(out)]
    assert main(words) == 0
    (out / "grasped.c").write_text(GRASPED)
    sources = [str(path.relative_to(out)) for path in out.glob("src/*.c")]
    compiled(out, "-O0", "grasped.c", *sources, "-o", "grasped", "-lm")
    grasps, payload = page["grasp_entries"](robot, "panda+shadow"), b""
    for shown_grasp in grasps:
        solids = [[s["kind"], *s["size"], *s["pose"]] for s in shown_grasp["solids"]]
        free = [np.nan] * 3
        vectors = [v or free for name in ("points", "normals") for v in shown_grasp[name]]
        numbers = [[len(solids)], *solids, *vectors]
        payload += b"".join(np.array(part, dtype=float).tobytes() for part in numbers)
    lines = output_of(out / "grasped", input=payload).splitlines()
    solver = ik.Solver(robot, scene=ik.Scene({}))
    for shown_grasp, line in zip(grasps, lines, strict=True):
        status, *words = line.split()
        grasp = ik.load_grasp(shown_grasp["name"])
        asked_for = zip(robot.fingers, shown_grasp["points"], shown_grasp["normals"], strict=True)
        contacts = {name: ik.Contact(*pair) for name, *pair in asked_for if pair[0] is not None}
        same_grasp = ik.Grasp(contacts, object=grasp.object, object_pose=grasp.object_pose)
        answer = solver.solve(same_grasp, diagnose=False)
        assert int(status) == answer.status == ik.Status.SOLVED, shown_grasp["name"]
        np.testing.assert_array_equal([float.fromhex(word) for word in words], answer.q)


@needs_gcc
def test_no_state_outside_the_struct(plain_project):
    project = plain_project
    compiled(project, "-O1", "-c", "src/arm_look_up.c", "src/arm_solver.c", "src/arm_judge.c")
    listed = output_of("nm", "-P", "arm_look_up.o", "arm_solver.o", "arm_judge.o", cwd=project)
    kinds = {line.split()[1]: line.split()[0] for line in listed.splitlines() if " " in line}
    assert "T" in kinds
    assert not set(kinds) & set("bBCsSgG"), kinds


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
def test_wrapper_in_cpp(project, tmp_path):
    text = tmp_path / "use.cpp"
    text.write_text(
        '#include "arm.hpp"\n'
        "int use(arm::Solver &solver, const arm::Vectors &p, const arm::Vectors &n) {\n"
        "  arm::Configuration q0 = solver.q();\n"
        "  return solver.solve(p, n, &q0) == arm::Status::solved ? 0 : 1;\n}\n"
    )
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only"]
    output_of("g++", *flags, f"-I{project / 'include'}", text)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--method", "ipopt"], "'ipopt'.*hand-first"),
        (["--prefix", "2nd arm"], "--prefix: .*'2nd arm'"),
        (["--scene", "0"], "--scene: .*'0'"),
        (["--scene", "2000"], "--scene: .*2000.*1000"),
        (["--target", "fpga"], "--target: .*'fpga'.*c, wasm"),
    ],
)
def test_bad_export_options_are_refused(tmp_path, capsys, words, complaint):
    out = tmp_path / "solver"
    assert main(["export", "kuka_lwr_barrett", "--out", str(out), *words]) == 2
    assert re.search(complaint, capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_other_folders_are_not_overwritten(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert main(["export", "kuka_lwr_barrett", "--out", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_earlier_export_is_replaced_completely(tmp_path):
    out = tmp_path / "solver"
    write_folder(out, {"old.c": "old"})
    write_folder(out, {"src/new.c": "new"})
    assert sorted(p.name for p in out.rglob("*") if p.is_file()) == [EXPORT_MARKER, "new.c"]

    with pytest.raises(TypeError):
        write_folder(out, {"src/first.c": "first", "src/second.c": None})
    assert sorted(p.name for p in out.rglob("*") if p.is_file()) == [EXPORT_MARKER, "new.c"]
    assert [path.name for path in tmp_path.iterdir()] == ["solver"]


@pytest.mark.parametrize(
    ("name", "prefix"),
    [
        ("kuka_lwr_barrett", "kuka_lwr_barrett"),
        ("Panda+Allegro", "panda_allegro"),
        ("7", "robot_7"),
    ],
)
def test_names_of_robots_become_names_of_c(name, prefix):
    assert export_prefix(None, name) == prefix


def test_file_names_do_not_end_comments():
    assert sanitized_name("arm */ #include <x>\n") == "arm __ _include _x__"


def test_kernels_compiled_ahead_with_progress(capsys):
    assert main(["compile", "kuka_lwr_barrett"]) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("COMPILED")
    lines = [line for line in captured.err.splitlines() if "kuka_lwr_barrett" in line]
    numbers = [re.findall(r"\b(\d+)/(\d+)\b", line)[-1] for line in lines]
    assert len(numbers) > 1
    assert numbers == [(str(i), str(len(numbers))) for i in range(1, len(numbers) + 1)]


def test_no_compiler_means_no_precompiled_kernels(monkeypatch, capsys):
    monkeypatch.setenv("CC", "none")
    assert main(["compile", "kuka_lwr_barrett"]) == 2
    assert "compiler" in capsys.readouterr().err


WARNED = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wdouble-promotion", "-Werror")


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


def test_limits_are_rounded_inwards(robot):
    lower, upper = SinglePrecision(robot).bounds
    for bounds in (lower, upper):
        assert np.array_equal(bounds, bounds.astype(np.float32))
    insets = np.minimum(lower - robot.lower, robot.upper - upper)
    assert (insets > 0.5 * SINGLE_ROUNDING).all()
    assert (insets < 5 * SINGLE_ROUNDING).all()


@needs_gcc
def test_trigonometric_functions_are_accurate_to_the_last_place(tmp_path):
    (tmp_path / "places.c").write_text(driver_text("elementary_single") + LAST_PLACES)
    output_of(
        "gcc", *WARNED, "-O1", "-ffp-contract=off", "places.c", "-o", "places", "-lm", cwd=tmp_path
    )
    lines = output_of(tmp_path / "places").splitlines()
    worst, special = (list(map(float, line.split())) for line in lines)
    assert max(worst[:2]) < 2
    assert max(worst[2:]) < 4
    assert special == pytest.approx([0.0, -np.pi, np.sin(1e6)], abs=1e-5)


@pytest.fixture(scope="module")
def single_project(robot: ik.ArmHand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Project of the shipped robot with a scene, in single precision."""
    out = tmp_path_factory.mktemp("single") / "solver"
    write_folder(out, c_project(robot, "arm", 8, single=True))
    return out


@pytest.mark.slow
def test_single_precision_export_contains_no_double(single_project):
    for path in (*single_project.glob("src/*"), *single_project.glob("include/*")):
        text = path.read_text()
        assert not re.search(r"\bdouble\b", re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.S))
        assert in_single_precision(text) == text


@pytest.mark.slow
@needs_gcc
def test_single_precision_solutions_hold_in_double_precision(single_project):
    """The test of the project passes under sanitizers, except for the long generated file."""
    other_lines = [
        f"src/{path.name}" for path in single_project.glob("src/*.c") if "_solve.c" not in path.name
    ]
    places = ("-Iinclude", "-Isrc", "-Itest", "-ffp-contract=off")
    output_of("gcc", *WARNED, *places, "-O0", "-c", "src/arm_solve.c", cwd=single_project)
    tests = ("test/test.c", "test/judge.c")
    command = (*WARNED, *SANITIZERS, *places, "-O0", *tests, *other_lines, "arm_solve.o")
    output_of("gcc", *command, "-lm", "-o", "stored", cwd=single_project)
    output = output_of(single_project / "stored")
    solved, expected_count = re.findall(r"(\d+) solved of (\d+) that", output)[0]
    assert int(expected_count) == 402
    assert int(solved) >= int(expected_count)
    assert ", 0 missed, " in output
    assert "wrong: 0" in output

    for program in ("example/main.c", "bench/bench.c"):
        output_of("gcc", *WARNED, "-Iinclude", "-fsyntax-only", program, cwd=single_project)


def test_webassembly_has_doubles(tmp_path, capsys):
    words = ["export", "kuka_lwr_barrett", "--out", str(tmp_path / "s"), "--single"]
    assert main([*words, "--target", "wasm"]) == 2
    assert "--single: " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
