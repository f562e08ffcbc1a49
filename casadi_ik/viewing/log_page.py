"""The page on which logs play: one solve, or two side by side."""

from __future__ import annotations

import html
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import viser
from numpy.typing import ArrayLike

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import LogError
from casadi_ik.grasps import Contact, Grasp
from casadi_ik.logs.events import EVENT_COLORS, plain_name, told
from casadi_ik.logs.solve import OneSolve, Stretch
from casadi_ik.problem.verdict import ContactVerdict
from casadi_ik.viewing.drawn import (
    Drags,
    DrawnContacts,
    DrawnRobot,
    draw_scene,
    look_at_robot,
    lowest,
    set_stage,
)
from casadi_ik.viewing.grasp_page import on_press, on_set
from casadi_ik.viewing.newest import Newest
from casadi_ik.viewing.request import PageRequest, request_of
from casadi_ik.viewing.words import block, legend, verdict_rows

SPEEDS = {"2 a second": 2.0, "10 a second": 10.0, "30 a second": 30.0}
"""Iterations that are played in a second."""

LEGEND = (
    (palette.TARGET, "asked for"),
    (palette.MET, "within tolerance"),
    (palette.MISSED, "out of it"),
)


@dataclass(frozen=True, eq=False)
class Track:
    """A solve.

    Attributes:
        solve: As the log has it.
        robot: What was solved for.
        label: What it is called: method and number.
        q: (k, n) by iteration [rad or m].
        asked: Its contacts.
    """

    solve: OneSolve
    robot: ArmHand
    label: str
    q: Array
    asked: PageRequest

    def __len__(self) -> int:
        return len(self.q)

    def verdicts(self, iteration: int) -> dict[str, ContactVerdict]:
        """By finger how far its contact is off in an iteration."""
        position, angle = self.errors
        found: dict[str, ContactVerdict] = {}
        for i, (finger, bound) in enumerate(
            zip(self.solve.fingers, self.solve.tolerances, strict=True)
        ):
            p, a = float(position[iteration, i]), float(angle[iteration, i])
            off = p > bound.position or a > bound.angle
            found[finger] = ContactVerdict(p, a, not off, bound)
        return found

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """(k, f) distances [m] and angles [rad]; where a step has none of its own, those of q."""
        solve = self.solve
        targets = np.broadcast_arrays(
            solve.target_points, solve.target_normals, np.zeros((len(self), 1, 1))
        )[:2]
        reached = self.robot.errors(self.q, *targets)
        recorded = solve.columns("position_error"), solve.columns("angle_error")
        position, angle = (
            np.where(np.isfinite(ours), ours, theirs)
            for ours, theirs in zip(recorded, reached, strict=True)
        )
        return position, angle

    @property
    def singular_values(self) -> dict[str, Array]:
        """(k,) by Jacobian; NaN where not computed."""
        found: dict[str, Array] = {}
        for name in self.solve.layout.names:
            if name.startswith("sigma_"):
                columns = self.solve.columns(name)
                short = plain_name(name.removeprefix("sigma_"))
                for i in range(columns.shape[1]):
                    of = f" {self.solve.name_of(name, i)}" if columns.shape[1] > 1 else ""
                    found[f"{short}{of}"] = columns[:, i]
        return found

    def stretch(self, iteration: int) -> Stretch:
        """The phase of an iteration."""
        return next(one for one in self.solve.stretches if one.first <= iteration <= one.last)

    def happened(self, iteration: int) -> list[str]:
        """What happened in an iteration, in words."""
        return [told(one) for one in self.solve.events if one.iteration == iteration]

    @property
    def eventful(self) -> list[int]:
        """Iterations in which something happened."""
        return sorted({one.iteration for one in self.solve.events})


def track_of(solve: OneSolve, robot: ArmHand) -> Track:
    """A solve, ready to be played.

    Raises:
        LogError: The log has kept no iterations of it.
    """
    if len(solve.rows) == 0:
        raise LogError(
            f"solve {solve.solve_id + 1} of {solve.method}: the log kept no iterations of it"
        )
    q = solve.columns("q")
    finite = np.asarray(np.isfinite(q).all(axis=1))
    q = np.where(finite[:, None], q, robot.home)
    contacts: dict[str, Contact] = {}
    for i, finger in enumerate(solve.fingers):
        point, normal = solve.target_points[i], solve.target_normals[i]
        faced = np.isfinite(normal).all()
        more = {
            name.removesuffix("s"): rows[i]
            for name, rows in solve.target_more.items()
            if np.isfinite(rows[i]).all()
        }
        if np.isfinite(point).all():
            contacts[finger] = Contact(point, normal if faced else None, **more)
        elif faced:
            contacts[finger] = Contact(direction=normal)
    grasp = Grasp(contacts) if contacts else None
    label = f"{solve.method} · solve {solve.solve_id + 1}"
    return Track(solve, robot, label, q, request_of(robot, grasp, q[0]))


class LogPage:
    """Solves that play; all of it belongs to the thread of `work`.

    Attributes:
        tracks: The solves.
        now: The iteration that is shown; a shorter solve stays at its last.
        work: What everything is done by.
    """

    def __init__(
        self, server: viser.ViserServer, tracks: Sequence[Track], scene: Scene | None = None
    ) -> None:
        """Draw everything.

        Args:
            server: The page.
            tracks: One solve or two.
            scene: What stood about each robot; None: nothing.
        """
        self.server, self.tracks, self.now = server, tuple(tracks), 0
        self._scene = scene
        first = tracks[0]
        set_stage(server, _title(tracks), lowest(scene))
        middle = len(first.q) // 2
        look_at_robot(server, first.robot, first.q[middle], wide=len(tracks))
        self._shown = [self._add(i, track) for i, track in enumerate(tracks)]
        self.count = max(map(len, tracks))
        self._playing = threading.Event()
        self._ended = threading.Event()
        self._add_panel()
        self.work = Newest(self._draw)
        self._player = threading.Thread(target=self._play, name="casadi-ik play", daemon=True)
        self._player.start()
        self.show(0)

    def show(self, iteration: int) -> None:
        """Show an iteration."""

        def work() -> None:
            self.now = min(max(iteration, 0), self.count - 1)

        self.work.put("iteration", work)

    def play(self, on: bool) -> None:
        """Play on from here, from the beginning if this is the end; or stop."""
        if on and self.now >= self.count - 1:
            self.show(0)
        (self._playing.set if on else self._playing.clear)()
        self._button.label = "Stop" if on else "Play"

    def jump(self, ahead: bool) -> None:
        """To the next iteration in which something happened, or the one before."""
        places = sorted({one for track in self.tracks for one in track.eventful})
        found = [one for one in places if (one > self.now if ahead else one < self.now)]
        if found:
            self.show(found[0] if ahead else found[-1])

    def stop(self) -> None:
        """End its threads."""
        self._ended.set()
        self._playing.set()
        self._player.join(10.0)
        self.work.stop()

    def _add(self, number: int, track: Track) -> tuple[DrawnRobot, DrawnContacts]:
        name = f"/log_{number}"
        frame = self.server.scene.add_frame(name, show_axes=False)
        frame.position = self._aside(number)
        drawn = DrawnRobot(self.server, track.robot, f"{name}/robot")
        contacts = DrawnContacts(self.server, track.asked, Drags(), name)
        if self._scene is not None:
            draw_scene(self.server, self._scene, name)
        if len(self.tracks) > 1:
            self.server.scene.add_label(
                f"{name}/label", track.label, position=(0.0, 0.0, 0.02), anchor="top-center"
            )
        return drawn, contacts

    def _aside(self, number: int) -> Array:
        """Where a robot stands."""
        if len(self.tracks) == 1:
            return np.zeros(3)
        track = self.tracks[0]
        links = np.array([pose[:3, 3] for pose in track.robot.links(track.q[-1]).values()])
        size = max(0.4, float(np.ptp(links, axis=0).max()))
        hand = track.robot.contacts(track.q[-1])[0].mean(axis=0)
        across = np.array([-hand[1], hand[0], 0.0])
        length = float(np.linalg.norm(across))
        across = across / length if length > 1e-3 else np.array([0.0, 1.0, 0.0])
        return (number - 0.5) * 1.1 * size * across

    def _add_panel(self) -> None:
        gui = self.server.gui
        self._slider = gui.add_slider("Iteration", 0, max(self.count - 1, 1), 1, 0)
        self._button = gui.add_button("Play", icon=None)
        self._jumps = gui.add_button_group("Events", ("previous", "next"))
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="10 a second")
        self._told = gui.add_html("")
        self._charts = gui.add_html("")
        gui.add_html(legend(LEGEND))

        on_set(self._slider, lambda number: self.show(int(number)))
        on_press(self._button, lambda _: self.play(not self._playing.is_set()))
        on_press(self._jumps, lambda _: self.jump(self._jumps.value == "next"))

    def _play(self) -> None:
        while not self._ended.wait(1.0 / SPEEDS.get(str(self._speed.value), 10.0)):
            self._playing.wait()
            if self._ended.is_set():
                return
            if self.now >= self.count - 1:
                self.play(False)
            else:
                self.show(self.now + 1)
                self.work.settle()

    def _draw(self) -> None:
        told, charts = [], []
        with self.server.atomic():
            for track, (drawn, contacts) in zip(self.tracks, self._shown, strict=True):
                i = min(self.now, len(track) - 1)
                drawn.place(track.q[i])
                frames = track.robot.contact_frames(track.q[i])
                by_finger = dict(zip(track.robot.fingers, frames, strict=True))
                contacts.reach(track.asked, by_finger, track.verdicts(i))
                told.append(_told(track, i, self.now))
                charts.append(_charts(track, i, len(self.tracks) > 1))
            self._told.content, self._charts.content = "".join(told), "".join(charts)
            if self._slider.value != self.now:
                self._slider.value = self.now
        self.server.flush()


def _title(tracks: Sequence[Track]) -> str:
    """Of the panel: methods alone where they tell the solves apart, else it would be cut off."""
    methods = [track.solve.method for track in tracks]
    apart = len(set(methods)) == len(methods) > 1
    return " / ".join(methods if apart else [track.label for track in tracks])


def _told(track: Track, i: int, asked: int) -> str:
    """Iteration, phase, errors and events in words."""
    solve = track.solve
    phase = plain_name(track.stretch(i).phase) or "one phase"
    color = palette.MET if solve.success else palette.MISSED
    last = i == len(track) - 1
    end = f'<b style="color:{color}">{solve.status.replace("_", " ")}</b>' if last else ""
    ended = f" (ended {asked - i} before)" if asked > i else ""
    head = (
        f'<div style="display:flex;justify-content:space-between"><span><b>{track.label}</b></span>'
        f'{end}</div><div class="ik-iteration">iteration <b>{i}</b> of {len(track) - 1}{ended} · '
        f"{html.escape(phase)}</div>"
    )
    events = "".join(
        f'<li style="margin:0.1em 0">{html.escape(line)}</li>' for line in track.happened(i)
    )
    events = f'<ul style="margin:0.2em 0;padding-left:1.1em">{events}</ul>' if events else ""
    return block(head + verdict_rows(track.verdicts(i)) + events)


def _charts(track: Track, i: int, titled: bool) -> str:
    """Errors and singular values over the iterations."""
    solve, count = track.solve, len(track)
    names = dict.fromkeys(stretch.phase for stretch in solve.stretches)
    shades = {name: palette.PHASES[k % len(palette.PHASES)] for k, name in enumerate(names)}
    marked = [one for one in solve.events if one.kind in EVENT_COLORS]
    ground = [
        _band(count, one.first - 0.5, one.last + 0.5, shades[one.phase]) for one in solve.stretches
    ]
    ground += [_line_at(count, one.iteration, EVENT_COLORS[one.kind], 1.0) for one in marked]
    position, angle = track.errors
    bound, of = solve.tolerances[0], f" · {solve.method}" if titled else ""
    far = {name: 1e3 * position[:, k] for k, name in enumerate(solve.fingers)}
    turned = {name: np.rad2deg(angle[:, k]) for k, name in enumerate(solve.fingers)}
    found = [
        chart(f"distance to the contact [mm]{of}", far, i, ground, 1e3 * bound.position),
        chart(f"angle to the normal [°]{of}", turned, i, ground, float(np.rad2deg(bound.angle))),
        chart(f"smallest singular values{of}", track.singular_values, i, ground),
    ]
    marks = [(shades[name], plain_name(name)) for name in shades if name]
    kinds = sorted({one.kind for one in marked})
    marks += [(EVENT_COLORS[kind], plain_name(kind.lower())) for kind in kinds]
    return "".join(found) + (legend(marks) if marks else "")


# Diagrams, as SVG.

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 340, 118, 40, 334, 8, 102
"""Of the picture, and the edges of the diagram in it [its own pixels]."""


def _x(count: int, iteration: ArrayLike) -> Array:
    return LEFT + np.clip((np.asarray(iteration) + 0.5) / max(count, 1), 0, 1) * (RIGHT - LEFT)


def _band(count: int, first: float, last: float, color: str) -> str:
    x, end = _x(count, [first, last])
    size = f'y="{TOP}" width="{end - x:.1f}" height="{BOTTOM - TOP}"'
    return f'<rect x="{x:.1f}" {size} fill="{color}"/>'


def _line_at(count: int, iteration: int, color: str, width: float, more: str = "") -> str:
    x, look = _x(count, iteration), f'stroke="{color}" stroke-width="{width}"{more}'
    return f'<path d="M{x:.1f} {TOP}V{BOTTOM}" {look}/>'


def chart(
    title: str,
    lines: Mapping[str, Array],
    now: int,
    ground: Sequence[str],
    bound: float | None = None,
) -> str:
    """A diagram over iterations with a logarithmic scale.

    Args:
        title: What it shows, with its unit.
        lines: (k,) by name; what is not positive is not drawn.
        now: The iteration that is shown.
        ground: What is under the lines: phases and events.
        bound: What has to be fallen below.
    """
    values = np.concatenate([*lines.values(), np.array([] if bound is None else [bound])])
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return ""
    count = len(next(iter(lines.values())))
    low = math.floor(math.log10(max(float(values.min()), float(values.max()) * 1e-9)))
    high = max(math.ceil(math.log10(float(values.max()))), low + 1)

    def y(value: ArrayLike) -> Array:
        share = np.clip((np.log10(value) - low) / (high - low), 0, 1)
        return TOP + (1 - share) * (BOTTOM - TOP)

    def path(line: Array, color: str) -> str:
        # Of more points than are seen the largest of neighbours.
        first = np.arange(0, count, -(-count // 400))
        most = np.fmax.reduceat(line, first)
        there = np.isfinite(most) & (most > 0)
        begins = there & ~np.append(False, there[:-1])
        points = zip(_x(count, first), y(np.where(there, most, 1.0)), there, begins, strict=True)
        moves = [f"{'M' if new else 'L'}{a:.1f} {b:.1f}" for a, b, drawn, new in points if drawn]
        look = 'fill="none" stroke-width="1.6" stroke-linejoin="round" stroke-linecap="round"'
        return f'<path d="{" ".join(moves)}h0" stroke="{color}" {look}/>' if moves else ""

    parts = list(ground)
    for decade in range(low, high + 1, max(1, (high - low) // 4)):
        at, name = float(y(10.0**decade)), f"{10.0**decade:g}"
        name = name if -3 <= decade <= 3 else f"1e{decade}"
        parts.append(
            f'<path d="M{LEFT} {at:.1f}H{RIGHT}" stroke="#fff"/>'
            f'<text x="{LEFT - 4}" y="{at + 3:.1f}" text-anchor="end">{name}</text>'
        )
    if bound is not None:
        dashes = f'stroke="{palette.INK}" stroke-dasharray="4 3"'
        parts.append(f'<path d="M{LEFT} {float(y(bound)):.1f}H{RIGHT}" {dashes}/>')
    names = []
    for i, (name, line) in enumerate(lines.items()):
        color = palette.LINES[i % len(palette.LINES)]
        value = f"{line[now]:.3g}" if math.isfinite(line[now]) else ""
        parts.append(path(line, color))
        names.append(
            f'<span style="margin-right:0.8em;white-space:nowrap"><span style="color:{color}">━'
            f"</span> {html.escape(name)} <b>{value}</b></span> "
        )
    parts.append(_line_at(count, now, palette.INK, 1.6, ' class="ik-now"'))
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 4}">0</text>')
    parts.append(f'<text x="{RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{count - 1}</text>')
    style = f"font-size:0.72em;color:{palette.INK};padding:0 1em;margin-bottom:0.45em"
    look = f"width:100%;display:block;font-size:9px;fill:{palette.FAINT}"
    return (
        f'<div style="{style}"><div><b>{html.escape(title)}</b></div>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="{look}">{"".join(parts)}</svg>'
        f"<div>{''.join(names)}</div></div>"
    )
