"""What stands beside a picture: verdicts, tables, bars, diagrams, and files that are handed out."""

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
from casadi_ik.app.viewer.request import Answer
from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.load_grasp import grasp_to_dict
from casadi_ik.solve.verdict import ContactVerdict

logger = logging.getLogger(__name__)

PICTURE = (1000, 1600)
"""Height and width of a saved picture [pixels]."""

TRACK = "rgba(128,140,152,0.28)"
"""Colour behind bars and lines, on light and on dark pages."""


UNITS = ((1e6, "µs"), (1e3, "ms"), (1.0, "s"))


def on_set(handle: Any, do: Callable[[Any], None]) -> None:
    """Tell of a control's value when a person, not the program, has changed it."""

    @handle.on_update
    async def _(event: Any) -> None:
        if event.client is not None:
            do(handle.value)


def on_press(button: Any, do: Callable[[Any], None]) -> None:
    """Tell of a button that is pressed in a browser."""

    @button.on_click
    async def _(event: Any) -> None:
        do(event.client)


# Texts; colours of text are the page's, light or dark.


def block(inner: str, size: float = 0.8, style: str = "") -> str:
    """A block of the panel."""
    return f'<div style="font-size:{size}em;line-height:1.5;padding:0 1em;{style}">{inner}</div>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """What and how much, in rows."""
    text = "".join(f"<tr><td>{what}</td><td><b>{much}</b></td></tr>" for what, much in rows)
    return f'<table style="width:100%">{text}</table>'


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """What colours mean: colour and meaning of each."""
    rows = "".join(
        f'<span style="white-space:nowrap;margin-right:0.9em"><span style="display:inline-block;'
        f"width:0.75em;height:0.75em;border-radius:50%;background:{color};margin-right:0.35em;"
        f'vertical-align:-0.05em"></span>{text}</span> '
        for color, text in entries
    )
    return block(rows, 0.75, "padding:0.2em 1em 0.4em")


def verdict_block(answer: Answer) -> str:
    """How it ended, in a word and a sentence; always of the same height."""
    color = palette.MET if answer.success else palette.MISSED
    scale, unit = next(one for one in UNITS if answer.seconds * one[0] < 1000 or one[0] == 1)
    took = f"{scale * answer.seconds:.3g} {unit}" if answer.seconds else ""
    head = (
        '<div style="display:flex;justify-content:space-between;align-items:baseline">'
        f'<b style="font-size:1.25em;color:{color}" class="ik-status">{answer.headline}</b>'
        f'<span style="color:{palette.FAINT}">{took}</span></div>'
    )
    said = html.escape(answer.sentence)
    style = "height:3em;overflow:hidden"
    return block(f'{head}<div class="ik-sentence" style="{style}" title="{said}">{said}</div>')


def results_block(answer: Answer) -> str:
    """Finger by finger how far each is off, method, clearance, and why not."""
    clear = "Collision not checked: there is no scene."
    if answer.clearance is not None and answer.closest is not None:
        pair = " and ".join(map(html.escape, answer.closest[0]))
        dot = f'<span style="color:{palette.NEAREST}">●</span>'
        clear = f"{dot} <b>{1e3 * answer.clearance:.1f} mm</b> between {pair}"
    elif answer.checked:
        clear = ""
    why = "".join(f'<li style="margin:0.15em 0">{html.escape(line)}</li>' for line in answer.lines)
    style = "margin:0.4em 0;padding-left:1.1em"
    why = f'<ul class="ik-why" style="{style}">{why}</ul>' if why else ""
    how = f'<div style="color:{palette.FAINT}">{html.escape(answer.how)}</div>'
    return block(
        f'{verdict_rows(answer.contacts)}<div class="ik-clearance">{clear}</div>{why}{how}'
    )


def verdict_rows(verdicts: Mapping[str, ContactVerdict]) -> str:
    """A table: finger, distance, angle."""
    rows = "".join(_row(finger, one) for finger, one in verdicts.items())
    return f'<table style="width:100%;border-collapse:collapse;margin:0.3em 0">{rows}</table>'


def _row(finger: str, verdict: ContactVerdict) -> str:
    free = math.isnan(verdict.position_error) and math.isnan(verdict.angle_error)
    color = palette.FAINT if free else palette.MET if verdict.ok else palette.MISSED
    far = "" if math.isnan(verdict.position_error) else f"{1e3 * verdict.position_error:.2f} mm"
    turn = "" if math.isnan(verdict.angle_error) else f"{math.degrees(verdict.angle_error):.2f}°"
    cell = "text-align:right;padding:0.1em 0 0.1em 0.8em;font-variant-numeric:tabular-nums"
    return (
        f'<tr style="color:{color}" class="ik-finger" data-finger="{html.escape(finger)}">'
        f"<td><b>{html.escape(finger)}</b></td>"
        f'<td style="{cell}">{"free" if free else far}</td><td style="{cell}">{turn}</td></tr>'
    )


def bars(description: RobotDescription, joints: Mapping[str, float]) -> str:
    """Where each joint is between its limits, as a bar each; within 1 % of one it is red."""
    rows = []
    ranges = zip(description.joint_lower, description.joint_upper, strict=True)
    for joint, value, (low, high) in zip(description.movable, joints.values(), ranges, strict=True):
        part = float(np.clip((value - low) / (high - low), 0.0, 1.0)) if high > low else 0.5
        color = palette.MISSED if min(part, 1 - part) < 0.01 else palette.LINES[1]
        scale, unit = (1e3, " mm") if joint.type == "prismatic" else (math.degrees(1), "°")
        name = html.escape(joint.name)
        rows.append(
            '<div style="display:flex;align-items:center;margin:0.22em 0">'
            f'<span style="flex:0 0 48%;overflow:hidden;text-overflow:ellipsis;white-space:nowrap"'
            f' title="{name}: {scale * low:.1f} to {scale * high:.1f}{unit}">{name}</span>'
            f'<span style="flex:1;height:0.5em;background:{TRACK};border-radius:0.25em;'
            f'position:relative"><span style="position:absolute;left:calc({100 * part:.1f}% - '
            f"0.3em);top:-0.1em;width:0.6em;height:0.7em;border-radius:0.2em;"
            f'background:{color}"></span></span>'
            f'<span style="flex:0 0 4.9em;text-align:right;font-variant-numeric:tabular-nums">'
            f"{scale * value:.1f}{unit}</span></div>"
        )
    return block("".join(rows), 0.72)


def parts_of(description: RobotDescription) -> dict[str, list[int]]:
    """Places of the motors by what they move: arm and hand, of a body trunk and those by side."""
    of_sides = {
        name: f"{side.name} {part}"
        for side in description.sides
        for part, names in (("arm", side.arm), ("hand", side.hand))
        for name in names
    }
    found: dict[str, list[int]] = {}
    for i, motor in enumerate(description.actuators):
        part = of_sides.get(motor.name, "trunk") if description.sides else motor.part
        found.setdefault(part, []).append(i)
    return found


Q_FORMATS = ("list [rad, m]", "list [deg, mm]", "dict [rad, m]", "dict [deg, mm]")
"""How a configuration is written to be copied."""


def q_text(names: Sequence[str], q: Array, units: Sequence[str], form: str) -> str:
    """A configuration (n,) as Python has it, in one of `Q_FORMATS`."""
    scales = [{"rad": np.rad2deg(1.0)}.get(unit, 1e3) if "deg" in form else 1.0 for unit in units]
    values = [round(float(value * scale), 9) for value, scale in zip(q, scales, strict=True)]
    return str(dict(zip(names, values, strict=True)) if form.startswith("dict") else values)


def copied_from(text: str) -> str:
    """A text with a button that puts it on the clipboard."""
    copy = (
        "const t=this.nextElementSibling;t.select();navigator.clipboard?"
        "navigator.clipboard.writeText(t.value):document.execCommand('copy');"
        "this.innerText='Copied';setTimeout(()=>{this.innerText='Copy q'},1200)"
    )
    look = "border:1px solid currentColor;border-radius:0.3em;padding:0.1em 0.8em;cursor:pointer"
    area = "width:100%;height:5.5em;font:0.9em monospace;background:transparent;color:inherit"
    return block(
        f'<button style="{look}" onclick="{html.escape(copy)}">Copy q</button>'
        f'<textarea readonly class="ik-q" aria-label="q" style="{area};margin-top:0.3em">'
        f"{html.escape(text)}</textarea>"
    )


# Diagrams, as SVG.

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 340, 118, 40, 334, 8, 102
"""Of the picture, and the edges of the diagram in it [its own pixels]."""


def chart(
    title: str,
    times: Array,
    lines: Mapping[str, Array],
    now: int,
    marks: Sequence[tuple[float, float, str]] = (),
    bound: float | None = None,
    linear: bool = False,
) -> str:
    """A diagram over time or iterations; "" where there is nothing to be drawn.

    Args:
        title: What it shows, with its unit.
        times: (k,) increasing.
        lines: (k,) by name; on a logarithmic scale what is not positive is not drawn.
        now: Which of the times is shown.
        marks: Coloured bands: from, to, colour.
        bound: What has to be fallen below.
        linear: Whether the scale is linear; otherwise logarithmic.
    """
    level = (lambda v: np.asarray(v, float)) if linear else np.log10
    values = np.concatenate([*lines.values(), np.array([] if bound is None else [bound])])
    values = values[np.isfinite(values) & (linear | (values > 0))]
    if not len(values):
        return ""
    least, most = float(values.min()), float(values.max())
    if linear:
        low, high = least, max(most, least + 1e-6)
        ticks = [low, (low + high) / 2, high]
    else:
        low = math.floor(math.log10(max(least, most * 1e-9)))
        high = max(math.ceil(math.log10(most)), low + 1)
        ticks = [10.0**decade for decade in range(low, high + 1, max(1, (high - low) // 4))]
    whole = max(float(times[-1] - times[0]), 1e-9)

    def x(time: ArrayLike) -> Array:
        return LEFT + np.clip((np.asarray(time) - times[0]) / whole, 0, 1) * (RIGHT - LEFT)

    def y(value: ArrayLike) -> Array:
        return BOTTOM - np.clip((level(value) - low) / (high - low), 0, 1) * (BOTTOM - TOP)

    def path(line: Array, color: str) -> str:
        # Of more points than are seen the largest of neighbours.
        first = np.arange(0, len(line), -(-len(line) // 400))
        line = np.fmax.reduceat(line, first)
        there = np.isfinite(line) & (linear | (line > 0))
        begins = there & ~np.append(False, there[:-1])
        points = zip(x(times[first]), y(np.where(there, line, 1.0)), there, begins, strict=True)
        moves = [f"{'M' if new else 'L'}{a:.1f} {b:.1f}" for a, b, drawn, new in points if drawn]
        look = 'fill="none" stroke-width="1.6" stroke-linejoin="round" stroke-linecap="round"'
        return f'<path d="{" ".join(moves)}h0" stroke="{color}" {look}/>' if moves else ""

    def across(value: float, look: str) -> str:
        return f'<path d="M{LEFT} {float(y(value)):.1f}H{RIGHT}" {look}/>'

    parts = [
        f'<rect x="{a:.1f}" y="{TOP}" width="{max(b - a, 1.0):.1f}" height="{BOTTOM - TOP}" '
        f'fill="{color}" fill-opacity="0.55"/>'
        for a, b, color in ((*x([start, end]), color) for start, end, color in marks)
    ]
    for value in ticks:
        at = f'x="{LEFT - 4}" y="{float(y(value)) + 3:.1f}" text-anchor="end"'
        parts.append(
            across(value, f'stroke="{TRACK}"')
            + f"<text {at}>{value:{'.0f' if linear else '.3g'}}</text>"
        )
    if bound is not None:
        parts.append(across(bound, f'stroke="{palette.FAINT}" stroke-dasharray="4 3"'))
    names = []
    for i, (name, line) in enumerate(lines.items()):
        color = palette.LINES[i % len(palette.LINES)]
        value = f"{line[now]:{'.1f' if linear else '.3g'}}" if math.isfinite(line[now]) else ""
        parts.append(path(line, color))
        names.append(
            f'<span style="margin-right:0.8em;white-space:nowrap"><span style="color:{color}">━'
            f"</span> {html.escape(name)} <b>{value}</b></span> "
        )
    here = f'd="M{float(x(times[now])):.1f} {TOP}V{BOTTOM}" stroke-width="1.6"'
    parts.append(f'<path class="ik-now" {here} stroke="{palette.FAINT}"/>')
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 4}">{times[0]:.3g}</text>')
    parts.append(f'<text x="{RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{times[-1]:.3g}</text>')
    look = f"width:100%;display:block;font-size:9px;fill:{palette.FAINT}"
    return block(
        f"<div><b>{html.escape(title)}</b></div>"
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="{look}">{"".join(parts)}</svg>'
        f"<div>{''.join(names)}</div>",
        0.72,
        "margin-bottom:0.45em",
    )


# Files that a page hands to the browser it is seen in.


def save_text(client: Any, name: str, text: str) -> None:
    """Send a text as a file."""
    client.send_file_download(name, text.encode(), save_immediately=True)


def save_picture(client: Any, name: str, patience: float = 20.0) -> None:
    """Send what a browser sees, drawn by it anew in print size, if it does draw in time [s]."""
    try:
        image = client.get_render(*PICTURE, transport_format="png", timeout=patience)
    except Exception as error:  # whatever it sends instead is read by imageio
        logger.debug("no picture: %s", error)
        return
    written = io.BytesIO()
    imageio.imwrite(written, np.asarray(image), extension=".png")
    client.send_file_download(f"{name}.png", written.getvalue(), save_immediately=True)


def file_name(name: str, otherwise: str) -> str:
    """A name as a file's, without its suffix."""
    return re.sub(r"\W+", "_", name) or otherwise


def grasp_text(grasp: Grasp, comment: str = "") -> str:
    """A grasp as YAML that `load_grasp` reads back to the last digit.

    Args:
        grasp: The grasp.
        comment: A line before it.
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
