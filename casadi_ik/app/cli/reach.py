"""Commands `casadi-ik map` and `casadi-ik place-base`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import load_robot_arg, located
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, write_json, writing
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.report import fields, files, headline
from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.files.arrays import Array


@command(
    Option("ROBOT", "robot name or YAML file"),
    Option(
        "--region VALUES...",
        "box corners: x y z x y z [m] (default: around the arm)",
        parse=lambda words: opt.numbers(words, 6, "x y z x y z"),
    ),
    Option("--orientations N", "number of palm orientations", 32, opt.integer(1)),
    Option("--resolution M", "distance of positions [m]", 0.05, opt.positive),
    Option("--meaning exact|tolerance", "palm pose itself, or within the solver's tolerance"),
    opt.LIMIT_MODE,
    Option("--jobs N", "threads", 1, opt.integer(1)),
    opt.out_option("MAP.npz", "output file of the map", opt.file_name(".npz", ".ply", ".parquet")),
    opt.picture("--picture", "picture of three layers"),
)
def reach_map(args: Arguments) -> CommandResult:
    """Map the palm poses that an arm can reach.

    Examples:
      casadi-ik map ur5e --out ur5e.npz --picture ur5e.png
      casadi-ik map panda --region 0.2 -0.4 0 0.8 0.4 0.6 --out panda.ply
      casadi-ik map my_robot.yaml --orientations 96 --jobs 4 --out my.parquet

    Every palm pose is REACHABLE (with joint positions as a witness, which forward
    kinematics confirms), UNREACHABLE (refuted by interval arithmetic) or OPEN. For an
    arm without an exact closed form, the solver searches witnesses within its
    tolerance, and nothing is refuted. Collisions are not considered.

    MAP.npz holds positions, rotations, code (0 OPEN, 1 REACHABLE, 2 UNREACHABLE) and q.
    MAP.ply is a point cloud of the positions, coloured by the share of reachable
    orientations. MAP.parquet has a row per palm pose.

    exit codes: 0 done, 2 bad input
    """
    robot = load_robot_arg(args.robot)
    outputs = {"--out": args.out, "--picture": args.picture}
    check_outputs(outputs)
    draw = None
    if args.picture is not None:
        with located("--picture", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_reach_map as draw
    region = None if args.region is None else np.reshape(args.region, (2, 3))
    meaning = {"exact": "exact", "tolerance": "within tolerance"}.get(args.meaning)
    reach = Solver(robot, limits=args.limits).reach_map(
        region, args.orientations, args.resolution, meaning, jobs=args.jobs
    )
    save = {".npz": reach.save, ".ply": reach.to_ply, ".parquet": reach.to_parquet}
    with writing(args.out, "--out"):
        save[args.out.suffix](args.out)
    if draw is not None:
        draw(reach, args.picture)
    title = headline(True, "MAP", f"of {robot.name}, {reach.meaning}")
    counts = fields({name: f"{count:,}" for name, count in reach.counts.items()})
    return CommandResult.of_parts(True, title, counts, *files(outputs))


@command(
    Option("PALMS", "file .npz with `palms` (k, 4, 4), or .npy, world frame"),
    opt.REQUIRED_ROBOT,
    Option(
        "--region VALUES...",
        "corners of the base positions: x y z x y z [m]",
        parse=lambda words: opt.numbers(words, 6, "x y z x y z"),
        required=True,
    ),
    Option("--resolution M", "size of the smallest boxes [m]", 0.02, opt.positive),
    Option("--max-time S", "time after which the search ends [s]", 10.0, opt.positive),
    opt.LIMIT_MODE,
    opt.out_option("PLACE.json", "output file of the placement"),
    opt.picture("--picture", "heat map of the bases"),
)
def place_base(args: Arguments) -> CommandResult:
    r"""Place an upright base so that the arm reaches most palm poses.

    Examples:
      casadi-ik place-base palms.npz --robot ur5e --region -1 -1 0 1 1 0 \
          --out place.json

    The search is a branch and bound: the report has the number of palm poses that the
    best base reaches, and a proved upper bound for all bases of the region. Collisions
    are not considered.

    PLACE.json holds pose (4, 4), base (x, y, z [m], yaw [rad]), count, upper_bound,
    reached (k) and q (null where not reached).

    exit codes: 0 a palm pose is reached, 1 none, 2 bad input
    """
    robot = load_robot_arg(args.robot)
    outputs = {"--out": args.out, "--picture": args.picture}
    check_outputs(outputs, inputs=[Path(args.palms)])
    draw = None
    if args.picture is not None:
        with located("--picture", (MissingExtraError,)):
            from casadi_ik.app.pictures import draw_base_placement as draw
    with located(args.palms):
        palms = _read_palms(Path(args.palms))
        placement = Solver(robot, limits=args.limits).place_base(
            palms, np.reshape(args.region, (2, 3)), args.resolution, args.max_time
        )
    arms = zip(placement.q.tolist(), placement.reached.tolist(), strict=True)
    data = {
        "robot": robot.name,
        "pose": placement.pose.tolist(),
        "base": placement.base.tolist(),
        "count": placement.count,
        "upper_bound": placement.upper_bound,
        "reached": placement.reached.tolist(),
        "q": [q if is_reached else None for q, is_reached in arms],
    }
    write_json(args.out, data)
    if draw is not None:
        draw(placement, args.picture)
    x, y, z, yaw = placement.base.tolist()
    report = fields(
        {
            "reached": f"{placement.count} of {len(palms)} palm poses",
            "bound": f"{placement.upper_bound} (proved for all bases of the region)",
            "base": f"{x:.3f} {y:.3f} {z:.3f} m, yaw {yaw:.3f} rad",
        }
    )
    title = headline(placement.count > 0, "PLACED", f"{robot.name}, {placement.time:.1f} s")
    return CommandResult.of_parts(placement.count > 0, title, report, *files(outputs))


def _read_palms(path: Path) -> Array:
    """Return the palm poses (k, 4, 4) of a file.

    Raises:
        InputError: The file cannot be read or has no palm poses.
    """
    try:
        content = np.load(path, allow_pickle=False)
        return content if isinstance(content, np.ndarray) else content["palms"]
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"palms: cannot be read: {error}; expected (k, 4, 4)") from error
