"""Content of the panel: verdicts, tables, bars, charts and downloads."""

from __future__ import annotations

import html
import io
import json
import logging
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import imageio.v3 as imageio
import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.app.drawing import palette
from casadi_ik.app.viewer.request import SolveResult
from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.load_grasp import grasp_to_dict
from casadi_ik.solve.verdict import ContactVerdict

logger = logging.getLogger(__name__)

PICTURE_SIZE = (1000, 1600)
"""Height and width of an exported picture [pixels]."""

TRACK_COLOR = "rgba(128,140,152,0.28)"
"""Colour behind bars and grid lines, on light and dark pages."""


TIME_UNITS = ((1e6, "µs"), (1e3, "ms"), (1.0, "s"))


def on_set(handle: Any, callback: Callable[[Any], None]) -> None:
    """Call back with the value of a control when a user has changed it."""

    @handle.on_update
    async def _(event: Any) -> None:
        if event.client is not None:
            callback(handle.value)


def on_press(button: Any, callback: Callable[[Any], None]) -> None:
    """Call back with the client when a button is pressed."""

    @button.on_click
    async def _(event: Any) -> None:
        callback(event.client)


# Texts; their colour follows the theme of the page.


def block(inner: str, size: float = 0.8, style: str = "") -> str:
    """Return a block of the panel."""
    return f'<div style="font-size:{size}em;line-height:1.5;padding:0 1em;{style}">{inner}</div>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of names and values."""
    text = "".join(f"<tr><td>{name}</td><td><b>{value}</b></td></tr>" for name, value in rows)
    return f'<table style="width:100%">{text}</table>'


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """Return a legend of colours and their meanings."""
    rows = "".join(
        f'<span style="white-space:nowrap;margin-right:0.9em"><span style="display:inline-block;'
        f"width:0.75em;height:0.75em;border-radius:50%;background:{color};margin-right:0.35em;"
        f'vertical-align:-0.05em"></span>{text}</span> '
        for color, text in entries
    )
    return block(rows, 0.75, "padding:0.2em 1em 0.4em")


def verdict_block(result: SolveResult) -> str:
    """Return headline and sentence of a result in a block of constant height."""
    color = palette.MET if result.success else palette.MISSED
    scale, unit = next(
        candidate
        for candidate in TIME_UNITS
        if result.solve_time * candidate[0] < 1000 or candidate[0] == 1
    )
    took = f"{scale * result.solve_time:.3g} {unit}" if result.solve_time else ""
    head = (
        '<div style="display:flex;justify-content:space-between;align-items:baseline">'
        f'<b style="font-size:1.25em;color:{color}" class="ik-status">{result.headline}</b>'
        f'<span style="color:{palette.FAINT}">{took}</span></div>'
    )
    sentence = html.escape(result.sentence)
    style = "height:3em;overflow:hidden"
    return block(
        f'{head}<div class="ik-sentence" style="{style}" title="{sentence}">{sentence}</div>'
    )


def results_block(result: SolveResult) -> str:
    """Return errors by finger, clearance, the reasons for a failure, and the summary."""
    clearance_text = "Collision not checked: no scene."
    if result.clearance is not None and result.closest is not None:
        pair = " and ".join(map(html.escape, result.closest[0]))
        marker = f'<span style="color:{palette.NEAREST}">●</span>'
        clearance_text = f"{marker} <b>{1e3 * result.clearance:.1f} mm</b> between {pair}"
    elif result.collision_checked:
        clearance_text = ""
    reasons_list = "".join(
        f'<li style="margin:0.15em 0">{html.escape(line)}</li>' for line in result.reasons
    )
    style = "margin:0.4em 0;padding-left:1.1em"
    if reasons_list:
        reasons_list = f'<ul class="ik-why" style="{style}">{reasons_list}</ul>'
    summary = f'<div style="color:{palette.FAINT}">{html.escape(result.summary)}</div>'
    return block(
        f'{verdict_rows(result.verdicts)}<div class="ik-clearance">{clearance_text}</div>'
        f"{reasons_list}{summary}"
    )


def verdict_rows(verdicts: Mapping[str, ContactVerdict]) -> str:
    """Return a table of fingers, distances and angles."""
    rows = "".join(_row(finger, verdict) for finger, verdict in verdicts.items())
    return f'<table style="width:100%;border-collapse:collapse;margin:0.3em 0">{rows}</table>'


def _row(finger: str, verdict: ContactVerdict) -> str:
    is_free = math.isnan(verdict.position_error) and math.isnan(verdict.angle_error)
    color = palette.FAINT if is_free else palette.MET if verdict.ok else palette.MISSED
    distance = (
        "" if math.isnan(verdict.position_error) else f"{1e3 * verdict.position_error:.2f} mm"
    )
    angle = "" if math.isnan(verdict.angle_error) else f"{math.degrees(verdict.angle_error):.2f}°"
    cell = "text-align:right;padding:0.1em 0 0.1em 0.8em;font-variant-numeric:tabular-nums"
    return (
        f'<tr style="color:{color}" class="ik-finger" data-finger="{html.escape(finger)}">'
        f"<td><b>{html.escape(finger)}</b></td>"
        f'<td style="{cell}">{"free" if is_free else distance}</td>'
        f'<td style="{cell}">{angle}</td></tr>'
    )


def bars(description: RobotDescription, joints: Mapping[str, float]) -> str:
    """Return a bar per joint with its position within its limits, red within 1 % of a limit."""
    rows = []
    ranges = zip(description.joint_lower, description.joint_upper, strict=True)
    for joint, value, (lower, upper) in zip(
        description.movable, joints.values(), ranges, strict=True
    ):
        fraction = (
            float(np.clip((value - lower) / (upper - lower), 0.0, 1.0)) if upper > lower else 0.5
        )
        color = palette.MISSED if min(fraction, 1 - fraction) < 0.01 else palette.LINE_COLORS[1]
        scale, unit = (1e3, " mm") if joint.type == "prismatic" else (math.degrees(1), "°")
        name = html.escape(joint.name)
        rows.append(
            '<div style="display:flex;align-items:center;margin:0.22em 0">'
            f'<span style="flex:0 0 48%;overflow:hidden;text-overflow:ellipsis;white-space:nowrap"'
            f' title="{name}: {scale * lower:.1f} to {scale * upper:.1f}{unit}">{name}</span>'
            f'<span style="flex:1;height:0.5em;background:{TRACK_COLOR};border-radius:0.25em;'
            f'position:relative"><span style="position:absolute;left:calc({100 * fraction:.1f}% - '
            f"0.3em);top:-0.1em;width:0.6em;height:0.7em;border-radius:0.2em;"
            f'background:{color}"></span></span>'
            f'<span style="flex:0 0 4.9em;text-align:right;font-variant-numeric:tabular-nums">'
            f"{scale * value:.1f}{unit}</span></div>"
        )
    return block("".join(rows), 0.72)


def motors_by_part(description: RobotDescription) -> dict[str, list[int]]:
    """Return the indices of the motors by part: arm and hand, for several sides also the trunk."""
    part_of_motor = {
        name: f"{side.name} {part}"
        for side in description.sides
        for part, names in (("arm", side.arm), ("hand", side.hand))
        for name in names
    }
    indices_by_part: dict[str, list[int]] = {}
    for i, motor in enumerate(description.actuators):
        part = part_of_motor.get(motor.name, "trunk") if description.sides else motor.part
        indices_by_part.setdefault(part, []).append(i)
    return indices_by_part


Q_FORMATS = ("list [rad, m]", "list [deg, mm]", "dict [rad, m]", "dict [deg, mm]")
"""Formats of a configuration to copy."""


def q_text(names: Sequence[str], q: Array, units: Sequence[str], format_name: str) -> str:
    """Return a configuration (n,) as Python code, in one of `Q_FORMATS`."""
    scales = [
        {"rad": np.rad2deg(1.0)}.get(unit, 1e3) if "deg" in format_name else 1.0 for unit in units
    ]
    values = [round(float(value * scale), 9) for value, scale in zip(q, scales, strict=True)]
    return str(dict(zip(names, values, strict=True)) if format_name.startswith("dict") else values)


def copyable_text(text: str) -> str:
    """Return a text with a button that copies it."""
    script = (
        "const t=this.nextElementSibling;t.select();navigator.clipboard?"
        "navigator.clipboard.writeText(t.value):document.execCommand('copy');"
        "this.innerText='Copied';setTimeout(()=>{this.innerText='Copy q'},1200)"
    )
    button_style = (
        "border:1px solid currentColor;border-radius:0.3em;padding:0.1em 0.8em;cursor:pointer"
    )
    area_style = "width:100%;height:5.5em;font:0.9em monospace;background:transparent;color:inherit"
    return block(
        f'<button style="{button_style}" onclick="{html.escape(script)}">Copy q</button>'
        f'<textarea readonly class="ik-q" aria-label="q" style="{area_style};margin-top:0.3em">'
        f"{html.escape(text)}</textarea>"
    )


# Charts as SVG.

CHART_WIDTH, CHART_HEIGHT = 340, 118
AXES_LEFT, AXES_RIGHT, AXES_TOP, AXES_BOTTOM = 40, 334, 8, 102
"""Size of a chart, and the edges of its axes [SVG units]."""


def chart(
    title: str,
    times: Array,
    lines: Mapping[str, Array],
    row: int,
    bands: Sequence[tuple[float, float, str]] = (),
    tolerance: float | None = None,
    linear: bool = False,
) -> str:
    """Return a chart over time or iterations; "" without values to draw.

    Args:
        title: Quantity and unit.
        times: (k,) Increasing times or iterations.
        lines: (k,) Values by name; a logarithmic scale omits values that are not positive.
        row: Index of the time shown.
        bands: Coloured bands: start, end, colour.
        tolerance: Value that the lines should fall below.
        linear: Use a linear scale instead of a logarithmic one.
    """
    transform = (lambda v: np.asarray(v, float)) if linear else np.log10
    values = np.concatenate([*lines.values(), np.array([] if tolerance is None else [tolerance])])
    values = values[np.isfinite(values) & (linear | (values > 0))]
    if not len(values):
        return ""
    minimum, maximum = float(values.min()), float(values.max())
    if linear:
        low, high = minimum, max(maximum, minimum + 1e-6)
        ticks = [low, (low + high) / 2, high]
    else:
        low = math.floor(math.log10(max(minimum, maximum * 1e-9)))
        high = max(math.ceil(math.log10(maximum)), low + 1)
        ticks = [10.0**decade for decade in range(low, high + 1, max(1, (high - low) // 4))]
    duration = max(float(times[-1] - times[0]), 1e-9)

    def x(time: ArrayLike) -> Array:
        return AXES_LEFT + np.clip((np.asarray(time) - times[0]) / duration, 0, 1) * (
            AXES_RIGHT - AXES_LEFT
        )

    def y(value: ArrayLike) -> Array:
        return AXES_BOTTOM - np.clip((transform(value) - low) / (high - low), 0, 1) * (
            AXES_BOTTOM - AXES_TOP
        )

    def path(line: Array, color: str) -> str:
        # Long lines are reduced to the maximum of neighbouring points.
        starts = np.arange(0, len(line), -(-len(line) // 400))
        line = np.fmax.reduceat(line, starts)
        is_drawn = np.isfinite(line) & (linear | (line > 0))
        is_start = is_drawn & ~np.append(False, is_drawn[:-1])
        points = zip(
            x(times[starts]), y(np.where(is_drawn, line, 1.0)), is_drawn, is_start, strict=True
        )
        moves = [
            f"{'M' if is_first else 'L'}{a:.1f} {b:.1f}" for a, b, draw, is_first in points if draw
        ]
        style = 'fill="none" stroke-width="1.6" stroke-linejoin="round" stroke-linecap="round"'
        return f'<path d="{" ".join(moves)}h0" stroke="{color}" {style}/>' if moves else ""

    def horizontal_line(value: float, style: str) -> str:
        return f'<path d="M{AXES_LEFT} {float(y(value)):.1f}H{AXES_RIGHT}" {style}/>'

    parts = [
        f'<rect x="{a:.1f}" y="{AXES_TOP}" width="{max(b - a, 1.0):.1f}" '
        f'height="{AXES_BOTTOM - AXES_TOP}" fill="{color}" fill-opacity="0.55"/>'
        for a, b, color in ((*x([start, end]), color) for start, end, color in bands)
    ]
    for value in ticks:
        anchor = f'x="{AXES_LEFT - 4}" y="{float(y(value)) + 3:.1f}" text-anchor="end"'
        parts.append(
            horizontal_line(value, f'stroke="{TRACK_COLOR}"')
            + f"<text {anchor}>{value:{'.0f' if linear else '.3g'}}</text>"
        )
    if tolerance is not None:
        parts.append(horizontal_line(tolerance, f'stroke="{palette.FAINT}" stroke-dasharray="4 3"'))
    names = []
    for i, (name, line) in enumerate(lines.items()):
        color = palette.LINE_COLORS[i % len(palette.LINE_COLORS)]
        value = f"{line[row]:{'.1f' if linear else '.3g'}}" if math.isfinite(line[row]) else ""
        parts.append(path(line, color))
        names.append(
            f'<span style="margin-right:0.8em;white-space:nowrap"><span style="color:{color}">━'
            f"</span> {html.escape(name)} <b>{value}</b></span> "
        )
    cursor = f'd="M{float(x(times[row])):.1f} {AXES_TOP}V{AXES_BOTTOM}" stroke-width="1.6"'
    parts.append(f'<path class="ik-now" {cursor} stroke="{palette.FAINT}"/>')
    parts.append(f'<text x="{AXES_LEFT}" y="{CHART_HEIGHT - 4}">{times[0]:.3g}</text>')
    parts.append(
        f'<text x="{AXES_RIGHT}" y="{CHART_HEIGHT - 4}" text-anchor="end">{times[-1]:.3g}</text>'
    )
    style = f"width:100%;display:block;font-size:9px;fill:{palette.FAINT}"
    return block(
        f"<div><b>{html.escape(title)}</b></div>"
        f'<svg viewBox="0 0 {CHART_WIDTH} {CHART_HEIGHT}" style="{style}">{"".join(parts)}</svg>'
        f"<div>{''.join(names)}</div>",
        0.72,
        "margin-bottom:0.45em",
    )


# Downloads.


def save_text(client: Any, name: str, text: str) -> None:
    """Send a text file to a browser."""
    client.send_file_download(name, text.encode(), save_immediately=True)


def save_picture(client: Any, name: str, timeout: float = 20.0) -> None:
    """Let a browser render its view in print size and download it; give up after a timeout [s]."""
    try:
        image = client.get_render(*PICTURE_SIZE, transport_format="png", timeout=timeout)
    except Exception as error:  # imageio may fail on any reply of the browser
        logger.debug("no picture: %s", error)
        return
    buffer = io.BytesIO()
    imageio.imwrite(buffer, np.asarray(image), extension=".png")
    client.send_file_download(f"{name}.png", buffer.getvalue(), save_immediately=True)


def file_name(name: str, default: str) -> str:
    """Return a name as the stem of a file name."""
    return re.sub(r"\W+", "_", name) or default


def grasp_text(grasp: Grasp, comment: str = "") -> str:
    """Return a grasp as YAML that `load_grasp` reads back exactly.

    Args:
        grasp: The grasp.
        comment: Comment in the first line.
    """
    lines = [f"# {comment}"] if comment else []
    for key, value in grasp_to_dict(grasp).items():
        if key == "contacts":
            lines.append("contacts:  # points [m] and outward normals of the pads, base frame")
            for finger, contact in value.items():
                lines += [f"  {_flow(finger)}:", *_lines(contact, "    ")]
        elif isinstance(value, dict):
            lines += [f"{key}:", *_lines(value, "  ")]
        else:
            lines.append(f"{key}: {_flow(value)}")
    return "\n".join(lines) + "\n"


def _lines(data: dict[str, Any], indent: str) -> list[str]:
    keys = {key: key if key.isidentifier() else _flow(key) for key in data}
    return [f"{indent}{keys[key]}: {_flow(value)}" for key, value in data.items()]


def _flow(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
