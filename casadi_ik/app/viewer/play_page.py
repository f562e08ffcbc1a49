"""The page that plays logged solves and motions: one, or two next to each other."""

from __future__ import annotations

import html
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import ground_height
from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.camera import add_lamp, cameras
from casadi_ik.app.viewer.page import Page, on_page_thread
from casadi_ik.app.viewer.panel import (
    block,
    chart,
    legend,
    motors_by_part,
    on_press,
    on_set,
    verdict_rows,
)
from casadi_ik.app.viewer.request import PageRequest, request_of
from casadi_ik.app.viewer.viser_scene import FingertipMarks, Handles, RobotView
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import InputError, LogError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.events import EVENT_COLORS, describe
from casadi_ik.logs.solve import SolveRecord
from casadi_ik.logs.wording import plain_name
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.solve.verdict import ContactVerdict

FRAME_RATE = 20.0
"""Frames per second during playback."""

PLAYBACK_LEGEND = (
    (palette.TARGET, "target"),
    (palette.MET, "within tolerance"),
    (palette.MISSED, "out of tolerance"),
)

SPEEDS = {
    "iteration": {"2 per second": 2.0, "10 per second": 10.0, "30 per second": 30.0},
    "s": {"1x": 1.0, "0.5x": 0.5, "0.1x": 0.1},
}
"""Playback speeds per second, by the unit of time."""


@dataclass(frozen=True, eq=False)
class Playback:
    """A motion of a robot.

    Attributes:
        robot: The robot.
        label: Name of the motion.
        times: (k,) Increasing times.
        q: (k, n) Configurations [rad or m].
        request: Contacts that are drawn.
    """

    robot: ArmHand
    label: str
    times: Array
    q: Array
    request: PageRequest

    unit = "s"

    def __len__(self) -> int:
        return len(self.q)

    def row_of(self, time: float) -> int:
        """Return the row at a time."""
        return int(np.clip(np.searchsorted(self.times, time + 1e-9, "right") - 1, 0, len(self) - 1))

    @property
    def event_times(self) -> list[float]:
        """Times of events."""
        return []

    def verdicts(self, row: int) -> dict[str, ContactVerdict]:
        """Return the verdicts of contacts by finger."""
        del row
        return {}

    def summary_html(self, row: int, time: float) -> str:
        """Return the current state in words."""
        del time
        return block(
            f'<b>{html.escape(self.label)}</b> · <span class="ik-iteration">'
            f"<b>{self.times[row]:.2f}</b> of {self.times[-1]:.2f} s</span>"
        )

    def charts(self, row: int) -> str:
        """Return charts of actuator positions and velocities over time."""
        motors = self.robot.description.actuators
        content = ""
        for unit, scale, unit_text in (("rad", np.rad2deg(1.0), "°"), ("m", 1e3, "mm")):
            for part, indices in motors_by_part(self.robot.description).items():
                motor_indices = [i for i in indices if motors[i].unit == unit]
                for suffix, values in (("", self.q), ("/s", self.velocity)):
                    lines = {motors[i].name: scale * values[:, i] for i in motor_indices}
                    title = f"{part} [{unit_text}{suffix}]"
                    if lines and len(self) > 1:
                        content += chart(title, self.times, lines, row, linear=True)
        return content

    @cached_property
    def velocity(self) -> Array:
        """(k, n) Velocities [rad/s or m/s]."""
        return np.gradient(self.q, self.times, axis=0) if len(self) > 1 else 0 * self.q


@dataclass(frozen=True, eq=False)
class SolvePlayback(Playback):
    """A logged solve, iteration by iteration.

    Attributes:
        solve: The logged solve.
    """

    solve: SolveRecord

    unit = "iteration"

    @property
    def event_times(self) -> list[float]:
        """Iterations with events."""
        return sorted({event.iteration + 1.0 for event in self.solve.events})

    def verdicts(self, row: int) -> dict[str, ContactVerdict]:
        """Return the verdicts of contacts by finger in an iteration."""
        verdicts: dict[str, ContactVerdict] = {}
        for i, (finger, tolerance) in enumerate(
            zip(self.solve.fingers, self.solve.tolerances, strict=True)
        ):
            p, a = (float(errors[row, i]) for errors in self.errors)
            is_missed = p > tolerance.position or a > tolerance.angle
            verdicts[finger] = ContactVerdict(p, a, not is_missed, tolerance)
        return verdicts

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """(k, f) Distances [m] and angles [rad]; computed from q where the log has none."""
        solve = self.solve
        targets = np.broadcast_arrays(
            solve.target_points, solve.target_normals, np.zeros((len(self), 1, 1))
        )[:2]
        computed = self.robot.errors(self.q, *targets)
        recorded = solve.columns("position_error"), solve.columns("angle_error")
        position, angle = (
            np.where(np.isfinite(recorded_values), recorded_values, computed_values)
            for recorded_values, computed_values in zip(recorded, computed, strict=True)
        )
        return position, angle

    @property
    def singular_values(self) -> dict[str, Array]:
        """(k,) Smallest singular values by Jacobian; NaN where they were not computed."""
        values: dict[str, Array] = {}
        for name in self.solve.layout.names:
            if name.startswith("sigma_"):
                columns = self.solve.columns(name)
                label = plain_name(name.removeprefix("sigma_"))
                for i in range(columns.shape[1]):
                    suffix = f" {self.solve.name_of(name, i)}" if columns.shape[1] > 1 else ""
                    values[f"{label}{suffix}"] = columns[:, i]
        return values

    def summary_html(self, row: int, time: float) -> str:
        """Return iteration, phase, errors and events in words."""
        solve = self.solve
        span = next(span for span in solve.phase_spans if span.first <= row <= span.last)
        phase = plain_name(span.phase) or "one phase"
        color = palette.MET if solve.success else palette.MISSED
        is_last = row == len(self) - 1
        status = f'<b style="color:{color}">{solve.status.replace("_", " ")}</b>' if is_last else ""
        iterations_since_end = round(time - self.times[row])
        ended_text = f" (ended {iterations_since_end} before)" if iterations_since_end > 0 else ""
        header = (
            f'<div style="display:flex;justify-content:space-between"><b>{self.label}</b>'
            f'{status}</div><div class="ik-iteration">iteration <b>{row + 1}</b> of {len(self)}'
            f"{ended_text} · {html.escape(phase)}</div>"
        )
        event_texts = [describe(event) for event in solve.events if event.iteration == row]
        # The list always has the height of three lines, so that the charts do not move.
        events = "".join(f"<li>{html.escape(line)}</li>" for line in event_texts)
        style = "margin:0.2em 0;padding-left:1.1em;height:4.5em;overflow:auto"
        return block(f'{header}{verdict_rows(self.verdicts(row))}<ul style="{style}">{events}</ul>')

    def charts(self, row: int) -> str:
        """Return charts of errors and singular values over the iterations."""
        solve, times = self.solve, self.times
        phases = dict.fromkeys(span.phase for span in solve.phase_spans)
        color_of_phase = {
            name: palette.PHASE_COLORS[k % len(palette.PHASE_COLORS)]
            for k, name in enumerate(phases)
        }
        events = [event for event in solve.events if event.kind in EVENT_COLORS]
        bands = [
            (span.first + 0.5, span.last + 1.5, color_of_phase[span.phase])
            for span in solve.phase_spans
        ]
        bands += [
            (event.iteration + 1, event.iteration + 1, EVENT_COLORS[event.kind]) for event in events
        ]
        position, angle = self.errors
        tolerance, method_suffix = solve.tolerances[0], f" · {solve.method}"
        distances = {name: 1e3 * position[:, k] for k, name in enumerate(solve.fingers)}
        angles = {name: np.rad2deg(angle[:, k]) for k, name in enumerate(solve.fingers)}
        angle_tolerance = float(np.rad2deg(tolerance.angle))
        charts = [
            chart(
                f"distance to the contact [mm]{method_suffix}",
                times,
                distances,
                row,
                bands,
                1e3 * tolerance.position,
            ),
            chart(
                f"angle to the normal [°]{method_suffix}",
                times,
                angles,
                row,
                bands,
                angle_tolerance,
            ),
            chart(
                f"smallest singular values{method_suffix}", times, self.singular_values, row, bands
            ),
        ]
        entries = [(color_of_phase[name], plain_name(name)) for name in color_of_phase if name]
        kinds = sorted({event.kind for event in events})
        entries += [(EVENT_COLORS[kind], plain_name(kind.lower())) for kind in kinds]
        return "".join(charts) + (legend(entries) if entries else "")


def solve_playback(solve: SolveRecord, robot: ArmHand) -> SolvePlayback:
    """Return the playback of a logged solve.

    Raises:
        LogError: The log has no iterations of the solve.
    """
    if len(solve.rows) == 0:
        raise LogError(f"solve {solve.solve_id + 1} of {solve.method}: the log has no iterations")
    q = solve.columns("q")
    is_finite = np.asarray(np.isfinite(q).all(axis=1))
    q = np.where(is_finite[:, None], q, robot.home)
    contacts: dict[str, Contact] = {}
    for i, finger in enumerate(solve.fingers):
        point, normal = solve.target_points[i], solve.target_normals[i]
        has_normal = np.isfinite(normal).all()
        constraints = {
            name.removesuffix("s"): rows[i]
            for name, rows in solve.target_more.items()
            if np.isfinite(rows[i]).all()
        }
        if np.isfinite(point).all():
            contacts[finger] = Contact(point, normal if has_normal else None, **constraints)
        elif has_normal:
            contacts[finger] = Contact(direction=normal)
    request = request_of(robot, Grasp(contacts) if contacts else None, q[0])
    label = f"{solve.method} · solve {solve.solve_id + 1}"
    return SolvePlayback(robot, label, np.arange(1.0, len(q) + 1.0), q, request, solve)


def motion_playback(
    robot: ArmHand, times: Array, q: Array, label: str = "", grasp: Grasp | None = None
) -> Playback:
    """Return the playback of a motion.

    Raises:
        InputError: Times and configurations do not fit the robot or each other.
    """
    q, times = robot.configuration(np.atleast_2d(q)), np.asarray(times, float)
    if times.shape != (len(q),) or not len(q) or not (np.diff(times) > 0).all():
        raise InputError(f"times: found shape {times.shape}, expected ({len(q)},), increasing")
    request = PageRequest({}) if grasp is None else request_of(robot, grasp, q[-1])
    return Playback(robot, label or robot.name, times, q, request)


class PlayPage(Page):
    """A page that plays one or two playbacks.

    Attributes:
        playbacks: One or two playbacks.
        time_shown: Current time; a shorter playback stays at its end.
    """

    def __init__(
        self,
        server: Server,
        playbacks: Sequence[Playback],
        scene: Scene | None = None,
        dark: bool | None = None,
    ) -> None:
        """Draw everything and start the threads.

        Args:
            server: Server of the page.
            playbacks: One or two playbacks.
            scene: Obstacles that are drawn around each robot; None: none.
            dark: Use the dark theme; None: follow the browser.
        """
        super().__init__(server, _title(playbacks), ground_height(playbacks[0].robot, scene), dark)
        self.playbacks, self.time_shown, self._scene = tuple(playbacks), 0.0, scene
        playback = playbacks[0]
        self._camera = cameras(playback.robot, playback.q[len(playback) // 2])["Robot"]
        scale = 1.0 if len(playbacks) == 1 else 1.65
        replace(self._camera, radius=scale * self._camera.radius).show(server)
        add_lamp(server, self._camera)
        self._views = [self._add(i, playback) for i, playback in enumerate(playbacks)]
        self.start_time = float(playback.times[0])
        self.end_time = max(float(playback.times[-1]) for playback in playbacks)
        self._play_event, self._stop_event = threading.Event(), threading.Event()
        self._add_panel()
        self.start()
        self._player = threading.Thread(target=self._play, name="casadi-ik play", daemon=True)
        self._player.start()
        self.show(self.start_time)

    @on_page_thread
    def show(self, time: float) -> None:
        """Show an iteration or a time."""
        self.time_shown = min(max(time, self.start_time), self.end_time)

    def play(self, is_playing: bool) -> None:
        """Play from the current time, or from the start if this is the end; or stop."""
        if is_playing and self.time_shown >= self.end_time:
            self.show(self.start_time)
            self.work.settle()
        (self._play_event.set if is_playing else self._play_event.clear)()
        self._button.label = "Stop" if is_playing else "Play"

    def jump(self, forward: bool) -> None:
        """Show the next time with an event, or the previous one."""
        event_times = sorted({time for playback in self.playbacks for time in playback.event_times})
        if forward:
            event_times = [time for time in event_times if time > self.time_shown]
        else:
            event_times = [time for time in event_times if time < self.time_shown]
        if event_times:
            self.show(event_times[0] if forward else event_times[-1])

    def stop(self) -> None:
        """Stop the threads."""
        self._stop_event.set()
        self._play_event.set()
        self._player.join(10.0)
        super().stop()

    def refresh(self) -> None:
        """Draw the current time."""
        summaries, charts = [], []
        with self.server.atomic():
            for playback, (robot_view, tips) in zip(self.playbacks, self._views, strict=True):
                row = playback.row_of(self.time_shown)
                robot_view.update(playback.q[row])
                frames = playback.robot.contact_frames(playback.q[row])
                by_finger = dict(zip(playback.robot.fingers, frames, strict=True))
                tips.update(playback.request, by_finger, playback.verdicts(row))
                summaries.append(playback.summary_html(row, self.time_shown))
                charts.append(playback.charts(row))
            self._summary.content, self._charts.content = "".join(summaries), "".join(charts)
            if self._slider.value != self.time_shown:
                self._slider.value = self.time_shown
        self.server.flush()

    def _add(self, number: int, playback: Playback) -> tuple[RobotView, FingertipMarks]:
        name = f"/track_{number}"
        frame = self.server.scene.add_frame(name, show_axes=False)
        frame.position = self._lateral_offset(number)
        robot_view = RobotView(self.server, playback.robot, f"{name}/robot")
        Handles(self.server, replace(playback.request, scene=self._scene), None, name)
        if len(self.playbacks) > 1:
            self.server.scene.add_label(
                f"{name}/label", playback.label, position=(0.0, 0.0, 0.02), anchor="top-center"
            )
        return robot_view, FingertipMarks(self.server, playback.request, name)

    def _lateral_offset(self, number: int) -> Array:
        """Return the position of a robot next to the other one."""
        direction = np.array([-self._camera.view[1], self._camera.view[0], 0.0])
        offset = 1.5 * self._camera.radius * (number - (len(self.playbacks) - 1) / 2)
        return offset * direction / np.linalg.norm(direction)

    def _add_panel(self) -> None:
        gui, unit = self.server.gui, self.playbacks[0].unit
        is_solve = unit == "iteration"
        label, step = ("Iteration", 1.0) if is_solve else ("Time [s]", 0.01)
        self._slider = gui.add_slider(
            label,
            self.start_time,
            max(self.end_time, self.start_time + step),
            step,
            self.start_time,
        )
        self._button = gui.add_button("Play", icon=None)
        if is_solve:
            jumps = gui.add_button_group("Events", ("previous", "next"))
            on_press(jumps, lambda _: self.jump(jumps.value == "next"))
        speeds: Mapping[str, float] = SPEEDS[unit]
        self._speed = gui.add_dropdown("Speed", tuple(speeds), initial_value=list(speeds)[is_solve])
        self._summary, self._charts = gui.add_html(""), gui.add_html("")
        if any(playback.request.contacts for playback in self.playbacks):
            gui.add_html(legend(PLAYBACK_LEGEND))
        self.add_theme_switch()
        on_set(self._slider, lambda time: self.show(float(time)))
        on_press(self._button, lambda _: self.play(not self._play_event.is_set()))

    def _play(self) -> None:
        speeds: Mapping[str, float] = SPEEDS[self.playbacks[0].unit]
        is_solve = self.playbacks[0].unit == "iteration"
        while True:
            speed = speeds.get(str(self._speed.value), 1.0)
            rate = min(speed, FRAME_RATE) if is_solve else FRAME_RATE
            if self._stop_event.wait(1.0 / rate):
                return
            self._play_event.wait()
            if self._stop_event.is_set():
                return
            if self.time_shown >= self.end_time:
                self.play(False)
            else:
                self.show(min(self.time_shown + speed / rate, self.end_time))
                self.work.settle()


def _title(playbacks: Sequence[Playback]) -> str:
    """Return the title: the methods alone if they differ, because long titles are cut off."""
    methods = [playback.label.partition(" · ")[0] for playback in playbacks]
    are_distinct = len(set(methods)) == len(methods) > 1
    return " / ".join(methods if are_distinct else [playback.label for playback in playbacks])
