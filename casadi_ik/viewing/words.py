"""What a page says, as HTML: verdicts, why not, joints within their limits."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from casadi_ik import palette
from casadi_ik.arrays import Array
from casadi_ik.problem.verdict import ContactVerdict
from casadi_ik.viewing.answering import Answered

AT_LIMIT = 0.01
"""Nearer to a limit than this part of its range, a motor counts as at it."""


def block(inner: str, size: float = 0.8) -> str:
    """A block of the panel."""
    style = f"font-size:{size}em;line-height:1.5;color:{palette.INK};padding:0 1em"
    return f'<div style="{style}">{inner}</div>'


def errors(verdict: ContactVerdict) -> str:
    """Distance and angle; what is free is left out."""
    parts = [] if math.isnan(verdict.position_error) else [f"{1e3 * verdict.position_error:.2f} mm"]
    if not math.isnan(verdict.angle_error):
        parts.append(f"{math.degrees(verdict.angle_error):.2f}°")
    return "  ".join(parts) or "free"


def verdict_block(answer: Answered, busy: str = "") -> str:
    """How it ended, finger by finger, clearance, and why not.

    Args:
        answer: What was found.
        busy: What is being done yet.
    """
    color = palette.MET if answer.success else palette.MISSED
    took = f"{1e3 * answer.seconds:.3g} ms" if answer.seconds >= 1e-3 else ""
    took = f"{1e6 * answer.seconds:.0f} µs" if 0 < answer.seconds < 1e-3 else took
    head = (
        f'<div style="display:flex;justify-content:space-between;align-items:baseline">'
        f'<b style="font-size:1.25em;color:{color}" class="ik-status">{answer.headline}</b>'
        f'<span style="color:{palette.FAINT}">{took}</span></div>'
        f'<div style="color:{palette.FAINT}">{html.escape(answer.how or busy)}</div>'
    )
    table = verdict_rows(answer.contacts)
    clear = ""
    if answer.clearance is not None and answer.closest is not None:
        pair = " and ".join(map(html.escape, answer.closest[0]))
        clear = (
            f'<div class="ik-clearance"><span style="color:{palette.NEAREST}">●</span> '
            f"<b>{1e3 * answer.clearance:.1f} mm</b> between {pair}</div>"
        )
    why = "".join(f'<li style="margin:0.15em 0">{html.escape(line)}</li>' for line in answer.lines)
    if why:
        why = (
            f'<ul class="ik-why" style="margin:0.4em 0;padding-left:1.1em;'
            f'color:{palette.MISSED}">{why}</ul>'
        )
    return block(head + table + clear + why)


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


def bars(
    names: Sequence[str], values: Array, lower: Array, upper: Array, units: Iterable[str]
) -> str:
    """Where each joint or motor is between its limits, as a bar each.

    Args:
        names: Their names.
        values: (n,) [rad or m].
        lower: (n,).
        upper: (n,).
        units: "rad" or "m" each.
    """
    rows = []
    for name, value, low, high, unit in zip(names, values, lower, upper, units, strict=True):
        part = float(np.clip((value - low) / (high - low), 0.0, 1.0)) if high > low else 0.5
        near = min(part, 1 - part) < AT_LIMIT
        color = palette.MISSED if near else palette.LINES[1]
        scale, digits = (math.degrees(1), "°") if unit == "rad" else (1e3, " mm")
        rows.append(
            '<div style="display:flex;align-items:center;margin:0.22em 0">'
            f'<span style="flex:0 0 48%;overflow:hidden;text-overflow:ellipsis;white-space:nowrap"'
            f' title="{html.escape(name)}: {scale * low:.1f} to {scale * high:.1f}{digits}">'
            f"{html.escape(name)}</span>"
            f'<span style="flex:1;height:0.5em;background:#e4e7ea;border-radius:0.25em;'
            f'position:relative"><span style="position:absolute;left:calc({100 * part:.1f}% - '
            f"0.3em);top:-0.1em;width:0.6em;height:0.7em;border-radius:0.2em;"
            f'background:{color}"></span></span>'
            f'<span style="flex:0 0 4.9em;text-align:right;font-variant-numeric:tabular-nums">'
            f"{scale * value:.1f}{digits}</span></div>"
        )
    return block("".join(rows), 0.72)
