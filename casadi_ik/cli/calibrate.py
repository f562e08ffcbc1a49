"""`casadi-ik calibrate`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from casadi_ik import calibration
from casadi_ik.cli.answer import Answer, Exit
from casadi_ik.cli.outputs import check_outputs, write_output
from casadi_ik.cli.question import the_robot
from casadi_ik.cli.report import fields, files, headline, table

UNITS = {"m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg")}


def calibrate(arguments: argparse.Namespace) -> Answer:
    """Estimate a hand's dimensions.

    Raises:
        CasadiIKError: Bad input, or an output that cannot be written.
    """
    data, out = Path(arguments.data), arguments.out
    robot = the_robot(arguments.robot).description
    measurements = calibration.read_measurements(data, robot)
    check_outputs([("--out", out)], inputs=[data])
    parameters = calibration.hand_parameters(
        robot, measurements.measured_fingers, arguments.estimate
    )
    found = calibration.calibrate(
        calibration.HandModel(robot, parameters), measurements, loss=arguments.loss
    )
    written: list[tuple[str, object]] = []
    if found.converged:
        write_output(
            out,
            "--out",
            lambda part: calibration.write_description(found, arguments.robot, part, data.name),
        )
        written = [("out", out)]
    return Answer(_report(found, written), Exit.DONE if found.converged else Exit.NOT_SOLVED)


def _report(found: calibration.Calibration, written: list[tuple[str, object]]) -> Group:
    count = f"{len(found.parameters)} numbers from {len(found.weights)} poses"
    status = "ESTIMATED" if found.converged else "NOT CONVERGED"
    noise = f"{1e3 * found.noise[0]:.3f} mm"
    if math.isfinite(found.noise[1]):
        noise += f", {math.degrees(found.noise[1]):.3f} deg"
    weak = len(found.unidentified())
    lines = {
        "tip misses, median": f"{1e3 * np.median(found.before[:, 0]):.3f} mm described, "
        f"{1e3 * np.median(found.after[:, 0]):.3f} mm estimated",
        "noise found" if found.noise_estimated else "noise assumed": noise,
        "outliers": f"{len(found.outliers)} poses count less than a quarter",
        "directions": f"{len(found.parameters)}, of which the data say less than the priors about "
        f"{weak}, and nothing about {found.unknown_directions}",
    }
    parts: list[RenderableType] = [headline(found.converged, status, count), fields(lines)]
    rows = table(
        "number",
        "described",
        "estimated",
        "±95%",
        "unit",
        "learned",
        right=("described", "estimated", "±95%", "learned"),
    )
    values = zip(
        found.parameters,
        found.values.tolist(),
        found.interval.tolist(),
        found.learned.tolist(),
        strict=True,
    )
    for parameter, value, interval, learned in values:
        scale, unit = UNITS[parameter.unit]
        rows.add_row(
            parameter.name,
            f"{scale * parameter.nominal:.3f}",
            f"{scale * value:.3f}",
            f"{scale * interval:.3f}",
            unit,
            f"{100 * learned:.0f} %",
        )
    parts.append(rows)
    if weak:
        parts.append(Text("  what the data cannot tell apart, the weakest first:"))
        for value, names in found.unidentified()[:5]:
            together = ", ".join(f"{part:+.2f} {name}" for name, part in list(names.items())[:4])
            parts.append(Text(f"  {value:8.1e}  {together}"))
    return Group(*parts, *files(written))
