"""A machine whose only compiler is the Python package ziglang works."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from processes import python

from casadi_ik.compile import LoopKernel
from casadi_ik.compile.compiler import find_compiler

from .graphs import branching_step, needs_compiler, random_step

pytestmark = pytest.mark.slow

NEEDS_ZIG = pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="needs the package ziglang"
)

FOLDER = Path(__file__).parent

OF_THE_COMPILER = (
    "bit_for_bit or last_places or finite or equals_vm or row_major or comes_back or threads "
    "or nearest or number"
)
"""Of the kernels' tests those whose outcome may be another with another compiler: arithmetic, the
order of numbers, vectors, locks. What C says in any case is said once."""

ITERATES = """
import sys
import numpy as np
from casadi_ik.compile import LoopKernel
from casadi_ik.compile.compiler import find_compiler
from tests.kernels.graphs import branching_step, random_step
print("ziglang" in find_compiler().command, file=sys.stderr)
rng = np.random.default_rng(0)
for step in (random_step(0), branching_step()):
    kernel = LoopKernel(step)
    assert kernel.compiled
    result = kernel.run(rng.normal(size=(40, 4)), rng.normal(size=(40, 2)), 300, trace=True)
    sys.stdout.buffer.write(result.states.tobytes() + result.rows.tobytes())
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment without a compiler on the path, with an empty cache.

    Zig's own is the user's: from nothing zig makes its libraries anew, which takes longer than all
    that is tested here.
    """
    tmp_path = tmp_path_factory.mktemp("zig")
    (tmp_path / "empty").mkdir()
    place = str(tmp_path / "empty")
    return {"CC": "", "PATH": place, "CASADI_IK_CACHE": str(tmp_path / "cache")}


@NEEDS_ZIG
def test_the_kernel_tests_pass(environment):
    files = ("test_loop.py", "test_function_kernel.py")
    done = python(
        *("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0"),
        *(FOLDER / name for name in files),
        *("-k", f"({OF_THE_COMPILER}) and not False"),
        env=environment,
        cwd=FOLDER.parents[1],
        timeout=900,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]
    assert "skipped" not in done.stdout


@NEEDS_ZIG
def test_iterates_match_another_compiler(environment):
    zig = python("-c", ITERATES, env=environment, text=False)
    assert zig.stderr.split()[:1] == [b"True"], zig.stderr
    usual = python("-c", ITERATES, text=False)
    if b"False" not in usual.stderr:
        pytest.skip("there is no other compiler to compare with")
    assert len(zig.stdout) > 10_000
    assert zig.stdout == usual.stdout


COUNT = 40


def iterates() -> bytes:
    """Return the iterates of single steps and of lanes."""
    rng = np.random.default_rng(0)
    counts = []
    for step in (random_step(0), branching_step()):
        kernel = LoopKernel(step)
        states, parameters = rng.normal(size=(COUNT, 4)), rng.normal(size=(COUNT, 2))
        single_run = kernel.run(states[:1], parameters[:1], 300, trace=True)
        _ = kernel.lanes
        result = kernel.run(states, parameters, 300, trace=True)
        assert single_run.rows is not None
        assert result.rows is not None
        counts += [single_run.rows.tobytes(), result.states.tobytes(), result.rows.tobytes()]
    return b"".join(counts)


@needs_compiler
def test_optimisation_changes_no_bit(monkeypatch):
    usual, flags = iterates(), find_compiler()
    assert len(usual) > 10_000
    monkeypatch.setenv("CASADI_IK_CFLAGS", "-O1")
    assert find_compiler() != flags
    assert iterates() == usual
