"""What a page says, as HTML: verdicts, why not, joints within their limits, legends."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping

import numpy as np

from casadi_ik import palette
from casadi_ik.problem.verdict import ContactVerdict
from casadi_ik.robots.description import RobotDescription
from casadi_ik.viewing.request import Answer


def block(inner: str, size: float = 0.8) -> str:
    """A block of the panel."""
    style = f"font-size:{size}em;line-height:1.5;color:{palette.INK};padding:0 1em"
    return f'<div style="{style}">{inner}</div>'


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
    style = f"font-size:0.75em;line-height:1.65;color:{palette.INK};padding:0.2em 1em 0.4em"
    return f'<div style="{style}">{rows}</div>'


def verdict_block(answer: Answer) -> str:
    """How it ended, finger by finger, clearance, and why not."""
    color = palette.MET if answer.success else palette.MISSED
    took = f"{1e3 * answer.seconds:.3g} ms" if answer.seconds >= 1e-3 else ""
    took = f"{1e6 * answer.seconds:.0f} µs" if 0 < answer.seconds < 1e-3 else took
    head = (
        f'<div style="display:flex;justify-content:space-between;align-items:baseline">'
        f'<b style="font-size:1.25em;color:{color}" class="ik-status">{answer.headline}</b>'
        f'<span style="color:{palette.FAINT}">{took}</span></div>'
        f'<div style="color:{palette.FAINT}">{html.escape(answer.how)}</div>'
    )
    clear = "collision not checked: no scene"
    if answer.clearance is not None and answer.closest is not None:
        pair = " and ".join(map(html.escape, answer.closest[0]))
        clear = (
            f'<span style="color:{palette.NEAREST}">●</span> '
            f"<b>{1e3 * answer.clearance:.1f} mm</b> between {pair}"
        )
    elif answer.checked:
        clear = ""
    why = "".join(f'<li style="margin:0.15em 0">{html.escape(line)}</li>' for line in answer.lines)
    look = f"margin:0.4em 0;padding-left:1.1em;color:{palette.MISSED}"
    why = f'<ul class="ik-why" style="{look}">{why}</ul>' if why else ""
    clear = f'<div class="ik-clearance">{clear}</div>' if clear else ""
    return block(head + verdict_rows(answer.contacts) + clear + why)


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
            f'<span style="flex:1;height:0.5em;background:#e4e7ea;border-radius:0.25em;'
            f'position:relative"><span style="position:absolute;left:calc({100 * part:.1f}% - '
            f"0.3em);top:-0.1em;width:0.6em;height:0.7em;border-radius:0.2em;"
            f'background:{color}"></span></span>'
            f'<span style="flex:0 0 4.9em;text-align:right;font-variant-numeric:tabular-nums">'
            f"{scale * value:.1f}{unit}</span></div>"
        )
    return block("".join(rows), 0.72)
