"""Contract of every method on every shipped robot."""

from __future__ import annotations

import dataclasses
import math
import pickle

import numpy as np
import pytest
from pinocchio_oracle import PinocchioRobot, assert_verdicts
from toy_robots import MULTI_ARM_ROBOTS, PAPER_METHODS, grasp_of, near_home

import casadi_ik as ik

ROBOTS = ik.shipped_names("arm_hands")
SLOW = {("original-dls", "baxter_ar10"), ("original-sdls", "baxter_ar10")}
"""Cases with a hierarchy of ten contact tasks on 17 motors, which takes minutes to compile."""

CHOOSING = ("hand-first", "thumb-first")
"""Methods that return the nearest of several solutions."""


CASES = [(m, r) for m in ik.METHODS for r in ROBOTS if (m, r) not in SLOW]
CASES += [("hand-first", body) for body in MULTI_ARM_ROBOTS]


@dataclasses.dataclass
class Case:
    """Method on a robot, with a few targets."""

    robot: ik.ArmHand
    method: str
    q: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    solvers: dict

    def solver(self, **options) -> ik.Solver:
        """Return a solver, built once per set of options."""
        key = repr(sorted(options.items()))
        if key not in self.solvers:
            self.solvers[key] = self.fresh_solver(**options)
        return self.solvers[key]

    def fresh_solver(self, **options) -> ik.Solver:
        """Return a new solver."""
        if self.method in PAPER_METHODS:
            options = {"finger_step": "closed-form"} | options
        if self.method.startswith("original"):
            # They oscillate for thousands of iterations; fewer suffice for the contract.
            options = {"options": {"max_iterations": 500}} | options
        return ik.Solver(self.robot, self.method, **options)

    def grasp(self, row: int = 0) -> ik.Grasp:
        return grasp_of(self.robot, self.points[row], self.normals[row])


SLOW_CASES = {("hand-first", "two_pandas+allegro"), ("hand-first", "two_ur10e+leap")}
SLOW_CASES |= {(f"{kind}-sdls", "kuka_lwr_barrett") for kind in ("enhanced", "original")}
SLOW_CASES |= {("original-sdls", "kuka_lwr_barrett_coupled")}
SLOW_CASES |= {("ipopt", "baxter_ar10")}
"""Cases that `make test` leaves out, because others cover their method and their robot."""


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(case, id="-".join(case), marks=pytest.mark.slow if case in SLOW_CASES else ())
        for case in CASES
    ],
)
def case(request) -> Case:
    method, name = request.param
    robot = ik.load_robot(name)
    q = near_home(robot, np.random.default_rng(7), 8)
    case = Case(robot, method, q, *robot.contacts(q), {})
    try:
        case.solver()
    except ik.errors.UnsupportedError as error:
        if name not in str(error):
            raise
        pytest.skip(str(error))
    return case


def fields_equal(a: ik.BatchSolution, b: ik.BatchSolution, rows=slice(None)) -> None:
    """Assert that all fields but the times are equal."""
    for item in dataclasses.fields(ik.BatchSolution):
        left, right = getattr(a, item.name), getattr(b, item.name)
        if item.name == "phases":
            assert set(left) == set(right)
            for name in left:
                np.testing.assert_array_equal(left[name][rows], right[name])
        elif item.name == "arm_hand":
            assert left.urdf() == right.urdf()
        elif not isinstance(left, np.ndarray):
            assert left == right
        elif item.name != "time":
            np.testing.assert_array_equal(left[rows], right, err_msg=item.name)


def test_fields_of_a_solution(case):
    robot = case.robot
    solution = case.solver().solve(case.grasp())
    assert isinstance(solution, ik.Solution)
    assert isinstance(solution.success, bool)
    assert isinstance(solution.status, ik.Status)
    assert solution.status is not ik.Status.RUNNING
    assert solution.success == (solution.status is ik.Status.SOLVED)
    assert solution.q.shape == (len(robot.actuators),)
    assert solution.iterations == sum(solution.phases.values()) >= 1
    assert solution.restarts >= 0
    assert solution.time > 0
    assert tuple(solution.contacts) == robot.fingers
    assert solution.actuators == robot.actuators
    assert (solution.method, solution.robot) == (case.method, robot.name)
    for contact in solution.contacts.values():
        within = contact.position_error <= 5e-3 and contact.angle_error <= math.radians(3)
        assert contact.ok == within


def test_fields_of_a_batch(case):
    k, f, n = len(case.points), len(case.robot.fingers), len(case.robot.actuators)
    batch = case.solver().solve_batch(case.points, case.normals)
    assert len(batch) == k
    shapes = {
        "q": (k, n), "position_error": (k, f), "angle_error": (k, f), "ok": (k, f),
    }  # fmt: skip
    for item in dataclasses.fields(ik.BatchSolution):
        if isinstance(getattr(batch, item.name), np.ndarray):
            assert getattr(batch, item.name).shape == shapes.get(item.name, (k,)), item.name
    assert batch.status_names.shape == (k,)
    assert set(batch.status_names) <= {status.name for status in ik.Status}
    np.testing.assert_array_equal(sum(batch.phases.values()), batch.iterations)
    np.testing.assert_array_equal(batch.success, batch.status_names == "SOLVED")
    restored = pickle.loads(pickle.dumps(batch))
    fields_equal(batch, restored)
    row = restored.solution(k - 1)
    assert tuple(row.contacts) == case.robot.fingers
    assert (row.method, row.robot) == (case.method, case.robot.name)
    assert row.actuators == case.robot.actuators
    np.testing.assert_array_equal(row.q, batch.q[k - 1])


def test_success_matches_pinocchio(case):
    """Pinocchio recomputes the verdict from q and the written URDF, with and without limits."""
    oracle = PinocchioRobot(case.robot)
    for limits in ("enforce", "ignore"):
        batch = case.solver(limits=limits).solve_batch(case.points, case.normals)
        assert_verdicts(oracle, batch, case.points, case.normals, limits == "enforce")


def test_targets_near_home_are_solved(case):
    batch = case.solver().solve_batch(case.points, case.normals)
    min_solved = 0 if case.method.startswith("original") else 6
    assert batch.success.sum() >= min_solved, batch.status_names


def test_the_same_seed_gives_the_same_answer(case):
    solver = case.solver()
    first = solver.solve_batch(case.points, case.normals, seed=3)
    fields_equal(first, solver.solve_batch(case.points, case.normals, seed=3))


def test_a_batch_is_its_single_solves(case):
    solver = case.solver()
    # A Contact normalises its normal again, which may change the last bit.
    points, normals = case.grasp().arrays(case.robot.fingers)
    batch = solver.solve_batch(points[None], normals[None], seed=2)
    single = solver.solve(case.grasp(), seed=2)
    np.testing.assert_array_equal(batch.q[0], single.q)
    assert batch.status[0] == single.status
    assert batch.iterations[0] == single.iterations
    if case.method in PAPER_METHODS:  # no random numbers: any row is its own solve
        whole_batch = solver.solve_batch(case.points, case.normals)
        for row in range(3):
            single_batch = solver.solve_batch(
                case.points[row : row + 1], case.normals[row : row + 1]
            )
            np.testing.assert_array_equal(whole_batch.q[row], single_batch.q[0])


def test_lanes_match_single_solves(case):
    """The code of every method can be vectorised, and one robot runs it in lanes."""
    options = {"finger_step": "closed-form"} if case.method.startswith("enhanced") else {}
    kernel = getattr(
        ik.solve.registry.build_method(case.method, case.robot.description, options), "kernel", None
    )
    if kernel is None or not kernel.compiled:
        pytest.skip("no compiled loop")
    if case.robot.name != "kuka_lwr_barrett":
        pytest.skip("one robot tells")
    assert kernel.lanes > 1
    one_by_one = [
        case.solver().solve_batch(point[None], normal[None])
        for point, normal in zip(case.points, case.normals, strict=True)
    ]
    batch = case.fresh_solver().solve_batch(case.points, case.normals)
    for row, single_batch in enumerate(one_by_one):
        fields_equal(batch, single_batch, slice(row, row + 1))


def test_threads_do_not_change_results(case):
    solver = case.solver()
    sequential = solver.solve_batch(case.points, case.normals, jobs=1, seed=1)
    fields_equal(sequential, solver.solve_batch(case.points, case.normals, jobs=2, seed=1))
    fields_equal(sequential, solver.solve_batch(case.points, case.normals, jobs=50, seed=1))


def test_starts_row_by_row(case):
    solver, robot = case.solver(), case.robot
    k = len(case.points)
    q0 = np.tile(robot.home, (k, 1))
    fields_equal(
        solver.solve_batch(case.points, case.normals, q0=robot.home),
        solver.solve_batch(case.points, case.normals, q0=q0),
    )
    preference = {"prefer": "limits"} if case.method in CHOOSING else {}
    home = solver.solve_batch(case.points, case.normals)
    fields_equal(home, solver.solve_batch(case.points, case.normals, q0=q0, **preference))
    q0_before = q0.copy()
    q0[1] = 0.5 * (robot.lower + robot.upper)
    shifted_batch = solver.solve_batch(case.points, case.normals, q0=q0, **preference)
    np.testing.assert_array_equal(shifted_batch.q[0], home.q[0])
    np.testing.assert_array_equal(q0_before[0], q0[0], "starts are not written to")


def test_solved_start_is_returned(case):
    """All methods but those of the paper, which start with a move, return a start that solves."""
    if case.method in PAPER_METHODS:
        pytest.skip("the paper's method reaches with the thumb first, wherever it is")
    batch = case.solver().solve_batch(case.points, case.normals, q0=case.q)
    np.testing.assert_array_equal(batch.q, case.q)
    assert batch.success.all()
    np.testing.assert_array_equal(case.solver().solve(case.grasp(), q0=case.q[0]).q, case.q[0])


def test_an_empty_batch(case):
    f = len(case.robot.fingers)
    batch = case.solver().solve_batch(np.empty((0, f, 3)), np.empty((0, f, 3)), jobs=2)
    assert len(batch) == 0
    assert batch.q.shape == (0, len(case.robot.actuators))


def test_unreachable_contacts_have_a_status(case):
    # The default is 50 restarts; three show the status.
    options = {"options": {"restarts": 3}} if case.method == "ipopt" else {}
    solver = case.solver(**options)
    solution = solver.solve_batch(case.points[:1] + 10.0, case.normals[:1])
    assert not solution.success[0]
    assert solution.status_names[0] in {"STALLED", "ITERATION_LIMIT", "UNREACHABLE"}
    assert np.all(np.isfinite(solution.q))


def test_logging_does_not_change_results(case, tmp_path):
    solver = case.solver()
    path = tmp_path / "solve.mcap"
    for count in (1, len(case.points)):  # alone, and side by side
        targets = case.points[:count], case.normals[:count]
        plain = solver.solve_batch(*targets, seed=4)
        fields_equal(plain, solver.solve_batch(*targets, seed=4, log=path))
    log = ik.logs.open(path)
    solves = log.solves().rows
    np.testing.assert_array_equal(solves["solve_id"], np.arange(len(case.points)))
    np.testing.assert_array_equal(solves["q"], plain.q)
    np.testing.assert_array_equal(solves["iterations"], plain.iterations)
    np.testing.assert_array_equal(solves["success"], plain.success)
    np.testing.assert_array_equal(solves["target_points"], case.points)
    assert [row["status"] for row in log.solves().records()] == plain.status_names.tolist()
    rows = log.iterations()
    np.testing.assert_array_equal(np.bincount(rows.solve_id), plain.iterations)
    assert log.attachment("robot.urdf").decode() == case.robot.urdf()
    parameters = log.metadata["parameters"]
    assert parameters["method"] == case.method
    assert parameters["limits"] == "enforce"


def test_bad_input_creates_no_log(case, tmp_path):
    path = tmp_path / "solve.mcap"
    with pytest.raises(ik.errors.InputError):
        case.solver().solve_batch(case.points, case.normals, q0=[1.0], log=path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"q0": np.zeros(3)}, r"q0: found shape \(3,\), expected"),
        ({"q0": "home"}, "q0: found 'home', expected numbers"),
        ({"jobs": 0}, "jobs: found 0, expected an integer >= 1"),
        ({"jobs": 1.5}, "jobs: found 1.5, expected an integer"),
        ({"jobs": "all"}, "jobs: found 'all'"),
        ({"seed": -1}, "seed: found -1, expected an integer >= 0"),
        ({"seed": None}, "seed: found None"),
        ({"points": np.zeros((8, 1, 3))}, r"points: found shape \(8, 1, 3\)"),
        ({"normals": None}, "normals: "),
    ],
)
def test_bad_arguments(case, change, says):
    arguments = {"points": case.points, "normals": case.normals} | change
    with pytest.raises(ik.errors.InputError, match=says) as caught:
        case.solver().solve_batch(**arguments)
    assert "\n" not in str(caught.value)


def test_number_of_starts_must_match_targets(case):
    q0 = np.tile(case.robot.home, (3, 1))
    with pytest.raises(ik.errors.InputError, match=r"q0:.*3.*8"):
        case.solver().solve_batch(case.points, case.normals, q0=q0)
    q0[1, 2] = np.nan
    with pytest.raises(ik.errors.InputError, match=r"q0: .*NaN"):
        case.solver().solve_batch(case.points[:3], case.normals[:3], q0=q0)


def test_grasp_of_another_hand_is_refused(case):
    with pytest.raises(ik.errors.InputError, match=r"contacts\.pinky:.*fingers: "):
        case.solver().solve(ik.Grasp({"pinky": ik.Contact([0, 0, 1])}))
    with pytest.raises(ik.errors.InputError, match=r"grasp:.*Grasp"):
        case.solver().solve("cup")


def test_parameters_are_complete(case):
    parameters = case.solver().parameters
    assert parameters["method"] == case.method
    assert parameters["tolerance"] == {
        name: {"position": 5e-3, "angle": math.radians(3)} for name in case.robot.fingers
    }
    assert parameters["limits"] == "enforce"
    assert isinstance(parameters["options"], dict)
    assert case.method in repr(case.solver())


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        (
            {"method": "newton"},
            ik.errors.UnknownNameError,
            "method 'newton' does not exist; methods: ",
        ),
        (
            {"limits": "maybe"},
            ik.errors.InputError,
            "limits: found 'maybe', expected one of enforce, ignore",
        ),
        ({"tolerance": 5e-3}, ik.errors.InputError, "tolerance: found 0.005, expected a Tolerance"),
        (
            {"method": "enhanced-dls", "options": {"speed": 3}},
            ik.errors.UnknownNameError,
            "option 'speed' does not exist for method 'enhanced-dls'; options: reaching_damping",
        ),
        (
            {"method": "enhanced-dls", "finger_step": "fmincon"},
            ik.errors.InputError,
            "finger_step: found 'fmincon', expected one of ipopt, closed-form",
        ),
    ],
)
def test_bad_solvers(robot, arguments, error, says):
    with pytest.raises(error) as caught:
        ik.Solver(robot, **arguments)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("method", "options", "says"),
    [
        ("hand-first", {"candidates": 0}, "candidates: found 0, expected a whole number >= 1"),
        ("hand-first", {"table": 4}, "table: found 4, expected at least"),
        ("thumb-first", {"step": "newton"}, "step: found 'newton', expected one of freeze, proxqp"),
        ("thumb-first", {"starts": 0}, "starts: found 0, expected a whole number >= 1"),
        ("thumb-first", {"table": 8}, "table: found 8, expected at least starts = 32"),
        ("thumb-first", {"step_cap": 0.0}, "step_cap: found 0.0, expected a number > 0"),
        ("ipopt", {"restarts": -1}, "restarts: found -1, expected an integer >= 0"),
        ("ipopt", {"restarts": True}, "restarts: found True"),
        ("ipopt", {"max_iterations": 0}, "max_iterations: found 0, expected an integer >= 1"),
        ("ipopt", {"optimality": 0}, "optimality: found 0, expected a number > 0"),
        ("ipopt", {"optimality": "small"}, "optimality: found 'small'"),
        ("ipopt", {"optimality": math.nan}, "optimality: found nan"),
        ("enhanced-dls", {"palm_error": 3}, "palm_error: found 3, expected one of euler"),
        (
            "enhanced-dls",
            {"platform": "hand"},
            "platform: found 'hand', expected one of arm-leg",
        ),
        ("enhanced-dls", {"chain_damping": 0.0}, "chain_damping: found 0.0, expected a number > 0"),
        ("enhanced-dls", {"chain_damping": math.nan}, "chain_damping: found nan"),
        (
            "enhanced-dls",
            {"reaching_damping": "much"},
            "reaching_damping: found 'much', expected",
        ),
        ("enhanced-dls", {"virtual_weight": -1}, "virtual_weight: found -1"),
        ("enhanced-dls", {"max_iterations": 0}, "max_iterations: found 0, expected an integer > 0"),
        ("enhanced-dls", {"max_iterations": 1.5}, "max_iterations: found 1.5, expected an integer"),
        ("enhanced-dls", {"borrowed": -1}, "borrowed: found -1, expected an integer >= 0"),
        ("enhanced-dls", {"borrowed": True}, "borrowed: found True"),
        ("enhanced-dls", {"borrowed": 7}, "borrowed: found 7, expected 0 to 6"),
        ("enhanced-dls", {"step_cap": 0.0}, "step_cap: found 0.0"),
    ],
)
def test_bad_options(robot, method, options, says):
    with pytest.raises(ik.errors.CasadiIKError) as caught:
        ik.Solver(robot, method, options=options)
    is_unsupported = isinstance(caught.value, ik.errors.UnsupportedError)
    assert is_unsupported == (options == {"borrowed": 7})
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_robot_name_is_not_a_robot():
    with pytest.raises(ik.errors.InputError, match=r"robot:.*'kuka_lwr_barrett'.*load_rob"):
        ik.Solver("kuka_lwr_barrett")


def test_every_method_has_a_summary():
    for method in ik.METHODS:
        assert "\n" not in ik.solve.registry.method_summary(method)
        assert len(ik.solve.registry.method_summary(method)) > 20
