"""The page on which solves and motions play: one, or two side by side."""

from __future__ import annotations

import html
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import lowest
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.page import Page, in_turn
from casadi_ik.app.viewer.panel import (
    block,
    chart,
    legend,
    on_press,
    on_set,
    parts_of,
    verdict_rows,
)
from casadi_ik.app.viewer.request import PageRequest, request_of
from casadi_ik.app.viewer.viser_scene import DrawnRobot, Handles, Tips, cameras, light_lamp
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError, LogError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.events import EVENT_COLORS, plain_name, told
from casadi_ik.logs.solve import OneSolve
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.solve.verdict import ContactVerdict

FRAMES = 20.0
"""A second, while it plays."""

LEGEND = (
    (palette.TARGET, "asked for"),
    (palette.MET, "within tolerance"),
    (palette.MISSED, "out of it"),
)

SPEEDS = {
    "iteration": {"2 a second": 2.0, "10 a second": 10.0, "30 a second": 30.0},
    "s": {"real time": 1.0, "half as fast": 0.5, "slow motion": 0.1},
}
"""What is played in a second, by the unit of time."""


@dataclass(frozen=True, eq=False)
class Track:
    """Where a robot is, time after time.

    Attributes:
        robot: The robot.
        label: What it is called.
        times: (k,) increasing.
        q: (k, n) [rad or m].
        asked: Contacts that are shown.
    """

    robot: ArmHand
    label: str
    times: Array
    q: Array
    asked: PageRequest

    unit = "s"

    def __len__(self) -> int:
        return len(self.q)

    def at(self, time: float) -> int:
        """The row of a time."""
        return int(np.clip(np.searchsorted(self.times, time + 1e-9, "right") - 1, 0, len(self) - 1))

    @property
    def eventful(self) -> list[float]:
        """Times at which something happened."""
        return []

    def verdicts(self, row: int) -> dict[str, ContactVerdict]:
        """By finger how far its contact is off."""
        del row
        return {}

    def told(self, row: int, time: float) -> str:
        """What is so now, in words."""
        del time
        return block(
            f'<b>{html.escape(self.label)}</b> · <span class="ik-iteration">'
            f"<b>{self.times[row]:.2f}</b> of {self.times[-1]:.2f} s</span>"
        )

    def charts(self, row: int) -> str:
        """Actuators and their velocities over time."""
        motors = self.robot.description.actuators
        found = ""
        for unit, scale, shown in (("rad", np.rad2deg(1.0), "°"), ("m", 1e3, "mm")):
            for part, places in parts_of(self.robot.description).items():
                chosen = [i for i in places if motors[i].unit == unit]
                for what, values in (("", self.q), ("/s", self.velocity)):
                    lines = {motors[i].name: scale * values[:, i] for i in chosen}
                    title = f"{part} [{shown}{what}]"
                    if lines and len(self) > 1:
                        found += chart(title, self.times, lines, row, linear=True)
        return found

    @cached_property
    def velocity(self) -> Array:
        """(k, n) [rad/s or m/s]."""
        return np.gradient(self.q, self.times, axis=0) if len(self) > 1 else 0 * self.q


@dataclass(frozen=True, eq=False)
class SolveTrack(Track):
    """A solve, iteration by iteration.

    Attributes:
        solve: As the log has it.
    """

    solve: OneSolve

    unit = "iteration"

    @property
    def eventful(self) -> list[float]:
        """Iterations in which something happened."""
        return sorted({one.iteration + 1.0 for one in self.solve.events})

    def verdicts(self, row: int) -> dict[str, ContactVerdict]:
        """By finger how far its contact is off in an iteration."""
        found: dict[str, ContactVerdict] = {}
        for i, (finger, bound) in enumerate(
            zip(self.solve.fingers, self.solve.tolerances, strict=True)
        ):
            p, a = (float(one[row, i]) for one in self.errors)
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

    def told(self, row: int, time: float) -> str:
        """Iteration, phase, errors and events in words."""
        solve = self.solve
        stretch = next(one for one in solve.stretches if one.first <= row <= one.last)
        phase = plain_name(stretch.phase) or "one phase"
        color = palette.MET if solve.success else palette.MISSED
        last = row == len(self) - 1
        end = f'<b style="color:{color}">{solve.status.replace("_", " ")}</b>' if last else ""
        before = round(time - self.times[row])
        ended = f" (ended {before} before)" if before > 0 else ""
        head = (
            f'<div style="display:flex;justify-content:space-between"><b>{self.label}</b>'
            f'{end}</div><div class="ik-iteration">iteration <b>{row + 1}</b> of {len(self)}'
            f"{ended} · {html.escape(phase)}</div>"
        )
        here = [told(one) for one in solve.events if one.iteration == row]
        # As high as three lines, so that what is below stays where it is.
        events = "".join(f"<li>{html.escape(line)}</li>" for line in here)
        style = "margin:0.2em 0;padding-left:1.1em;height:4.5em;overflow:auto"
        return block(f'{head}{verdict_rows(self.verdicts(row))}<ul style="{style}">{events}</ul>')

    def charts(self, row: int) -> str:
        """Errors and singular values over the iterations."""
        solve, times = self.solve, self.times
        names = dict.fromkeys(stretch.phase for stretch in solve.stretches)
        shades = {name: palette.PHASES[k % len(palette.PHASES)] for k, name in enumerate(names)}
        marked = [one for one in solve.events if one.kind in EVENT_COLORS]
        marks = [(one.first + 0.5, one.last + 1.5, shades[one.phase]) for one in solve.stretches]
        marks += [(one.iteration + 1, one.iteration + 1, EVENT_COLORS[one.kind]) for one in marked]
        position, angle = self.errors
        bound, of = solve.tolerances[0], f" · {solve.method}"
        far = {name: 1e3 * position[:, k] for k, name in enumerate(solve.fingers)}
        turned = {name: np.rad2deg(angle[:, k]) for k, name in enumerate(solve.fingers)}
        widest = float(np.rad2deg(bound.angle))
        found = [
            chart(
                f"distance to the contact [mm]{of}", times, far, row, marks, 1e3 * bound.position
            ),
            chart(f"angle to the normal [°]{of}", times, turned, row, marks, widest),
            chart(f"smallest singular values{of}", times, self.singular_values, row, marks),
        ]
        words = [(shades[name], plain_name(name)) for name in shades if name]
        kinds = sorted({one.kind for one in marked})
        words += [(EVENT_COLORS[kind], plain_name(kind.lower())) for kind in kinds]
        return "".join(found) + (legend(words) if words else "")


def track_of(solve: OneSolve, robot: ArmHand) -> SolveTrack:
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
    asked = request_of(robot, Grasp(contacts) if contacts else None, q[0])
    label = f"{solve.method} · solve {solve.solve_id + 1}"
    return SolveTrack(robot, label, np.arange(1.0, len(q) + 1.0), q, asked, solve)


def motion_track(
    robot: ArmHand, times: Array, q: Array, label: str = "", grasp: Grasp | None = None
) -> Track:
    """A motion, ready to be played.

    Raises:
        InputError: Times and positions do not fit the robot or each other.
    """
    q, times = robot.configuration(np.atleast_2d(q)), np.asarray(times, float)
    if times.shape != (len(q),) or not len(q) or not (np.diff(times) > 0).all():
        raise InputError(f"times: found shape {times.shape}, expected ({len(q)},) that increase")
    asked = PageRequest({}) if grasp is None else request_of(robot, grasp, q[-1])
    return Track(robot, label or robot.name, times, q, asked)


class PlayPage(Page):
    """Tracks that play.

    Attributes:
        tracks: One or two.
        now: The time that is shown; a shorter track stays at its last.
    """

    def __init__(
        self,
        server: Server,
        tracks: Sequence[Track],
        scene: Scene | None = None,
        dark: bool = False,
    ) -> None:
        """Draw everything.

        Args:
            server: What serves it.
            tracks: One or two.
            scene: What stood about each robot; None: nothing.
            dark: Whether the page is dark.
        """
        super().__init__(server, _title(tracks), lowest(tracks[0].robot, scene), dark)
        self.tracks, self.now, self._scene = tuple(tracks), 0.0, scene
        first = tracks[0]
        self._camera = cameras(first.robot, first.q[len(first) // 2])["Robot"]
        wider = 1.0 if len(tracks) == 1 else 1.65
        replace(self._camera, radius=wider * self._camera.radius).show(server)
        light_lamp(server, self._camera)
        self._shown = [self._add(i, track) for i, track in enumerate(tracks)]
        self.start = float(first.times[0])
        self.end = max(float(track.times[-1]) for track in tracks)
        self._playing, self._over = threading.Event(), threading.Event()
        self._add_panel()
        self.begin()
        self._player = threading.Thread(target=self._play, name="casadi-ik play", daemon=True)
        self._player.start()
        self.show(self.start)

    @in_turn
    def show(self, time: float) -> None:
        """Show an iteration or a time."""
        self.now = min(max(time, self.start), self.end)

    def play(self, on: bool) -> None:
        """Play on from here, from the beginning if this is the end; or stop."""
        if on and self.now >= self.end:
            self.show(self.start)
            self.work.settle()
        (self._playing.set if on else self._playing.clear)()
        self._button.label = "Stop" if on else "Play"

    def jump(self, ahead: bool) -> None:
        """To the next time at which something happened, or the one before."""
        places = sorted({one for track in self.tracks for one in track.eventful})
        found = [one for one in places if (one > self.now if ahead else one < self.now)]
        if found:
            self.show(found[0] if ahead else found[-1])

    def stop(self) -> None:
        """End its threads."""
        self._over.set()
        self._playing.set()
        self._player.join(10.0)
        super().stop()

    def refresh(self) -> None:
        """Draw the time that is shown."""
        told, charts = [], []
        with self.server.atomic():
            for track, (drawn, tips) in zip(self.tracks, self._shown, strict=True):
                row = track.at(self.now)
                drawn.place(track.q[row])
                frames = track.robot.contact_frames(track.q[row])
                by_finger = dict(zip(track.robot.fingers, frames, strict=True))
                tips.place(track.asked, by_finger, track.verdicts(row))
                told.append(track.told(row, self.now))
                charts.append(track.charts(row))
            self._told.content, self._charts.content = "".join(told), "".join(charts)
            if self._slider.value != self.now:
                self._slider.value = self.now
        self.server.flush()

    def _add(self, number: int, track: Track) -> tuple[DrawnRobot, Tips]:
        name = f"/track_{number}"
        frame = self.server.scene.add_frame(name, show_axes=False)
        frame.position = self._aside(number)
        drawn = DrawnRobot(self.server, track.robot, f"{name}/robot")
        Handles(self.server, replace(track.asked, scene=self._scene), None, name)
        if len(self.tracks) > 1:
            self.server.scene.add_label(
                f"{name}/label", track.label, position=(0.0, 0.0, 0.02), anchor="top-center"
            )
        return drawn, Tips(self.server, track.asked, name)

    def _aside(self, number: int) -> Array:
        """Where a robot stands."""
        right = np.array([-self._camera.view[1], self._camera.view[0], 0.0])
        away = 1.5 * self._camera.radius * (number - (len(self.tracks) - 1) / 2)
        return away * right / np.linalg.norm(right)

    def _add_panel(self) -> None:
        gui, unit = self.server.gui, self.tracks[0].unit
        solves = unit == "iteration"
        label, step = ("Iteration", 1.0) if solves else ("Time [s]", 0.01)
        self._slider = gui.add_slider(
            label, self.start, max(self.end, self.start + step), step, self.start
        )
        self._button = gui.add_button("Play", icon=None)
        if solves:
            jumps = gui.add_button_group("Events", ("previous", "next"))
            on_press(jumps, lambda _: self.jump(jumps.value == "next"))
        speeds: Mapping[str, float] = SPEEDS[unit]
        self._speed = gui.add_dropdown("Speed", tuple(speeds), initial_value=list(speeds)[solves])
        self._told, self._charts = gui.add_html(""), gui.add_html("")
        if any(track.asked.held for track in self.tracks):
            gui.add_html(legend(LEGEND))
        self.add_dark()
        on_set(self._slider, lambda time: self.show(float(time)))
        on_press(self._button, lambda _: self.play(not self._playing.is_set()))

    def _play(self) -> None:
        speeds: Mapping[str, float] = SPEEDS[self.tracks[0].unit]
        solves = self.tracks[0].unit == "iteration"
        while True:
            speed = speeds.get(str(self._speed.value), 1.0)
            rate = min(speed, FRAMES) if solves else FRAMES
            if self._over.wait(1.0 / rate):
                return
            self._playing.wait()
            if self._over.is_set():
                return
            if self.now >= self.end:
                self.play(False)
            else:
                self.show(min(self.now + speed / rate, self.end))
                self.work.settle()


def _title(tracks: Sequence[Track]) -> str:
    """Of the panel: methods alone where they tell the solves apart, else it would be cut off."""
    methods = [track.label.partition(" · ")[0] for track in tracks]
    apart = len(set(methods)) == len(methods) > 1
    return " / ".join(methods if apart else [track.label for track in tracks])
