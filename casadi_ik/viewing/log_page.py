"""The page on which logs play: one solve, or two side by side."""

from __future__ import annotations

import html
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from casadi_ik import palette
from casadi_ik.arrays import Array
from casadi_ik.collision.scene import Scene
from casadi_ik.logs.events import EVENT_COLORS, plain_name
from casadi_ik.viewing.charts import Course, chart
from casadi_ik.viewing.drawn_contacts import Drags, DrawnContacts
from casadi_ik.viewing.drawn_robot import DrawnRobot
from casadi_ik.viewing.drawn_things import draw_scene, lowest
from casadi_ik.viewing.log_track import Track
from casadi_ik.viewing.newest import Newest
from casadi_ik.viewing.robot_parts import robot_parts
from casadi_ik.viewing.stage import legend, look_at_robot, set_stage
from casadi_ik.viewing.words import block, verdict_rows

APART = 1.1
"""How far two robots stand from each other, in sizes of the larger."""

SPEEDS = {"2 a second": 2.0, "10 a second": 10.0, "30 a second": 30.0}
"""Iterations that are played in a second."""

LEGEND = (
    (palette.TARGET, "asked for"),
    (palette.MET, "within tolerance"),
    (palette.MISSED, "out of it"),
)


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
        drawn = DrawnRobot(self.server, track.robot, robot_parts(track.robot), name=f"{name}/robot")
        contacts = DrawnContacts(self.server, track.asked, NOBODY, name)
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
        return (number - 0.5) * APART * size * across

    def _add_panel(self) -> None:
        gui = self.server.gui
        self._slider = gui.add_slider("Iteration", 0, max(self.count - 1, 1), 1, 0)
        self._button = gui.add_button("Play", icon=None)
        self._jumps = gui.add_button_group("Events", ("previous", "next"))
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="10 a second")
        self._told = gui.add_html("")
        self._charts = gui.add_html("")
        gui.add_html(legend(LEGEND))

        @self._slider.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self.show(int(self._slider.value))

        @self._button.on_click
        async def _(_: Any) -> None:
            self.play(not self._playing.is_set())

        @self._jumps.on_click
        async def _(_: Any) -> None:
            self.jump(self._jumps.value == "next")

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


def _nothing(*_: Any) -> None:
    """Nobody is told: what a log asks for cannot be dragged."""


NOBODY = Drags(_nothing, _nothing, _nothing, _nothing)


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
    solve = track.solve
    names = {stretch.phase: None for stretch in solve.stretches}
    shades = {
        name: palette.PHASES[k % len(palette.PHASES)] for k, name in enumerate(dict.fromkeys(names))
    }
    course = Course(
        len(track),
        [(one.first, one.last, shades[one.phase]) for one in solve.stretches],
        [
            (one.iteration, EVENT_COLORS[one.kind])
            for one in solve.events
            if one.kind in EVENT_COLORS
        ],
        i,
    )
    position, angle = track.errors
    bound = solve.tolerances[0]
    of = f" · {solve.method}" if titled else ""
    fingers = solve.fingers
    found = chart(
        f"distance to the contact [mm]{of}",
        {name: 1e3 * position[:, k] for k, name in enumerate(fingers)},
        course,
        1e3 * bound.position,
    )
    found += chart(
        f"angle to the normal [°]{of}",
        {name: np.rad2deg(angle[:, k]) for k, name in enumerate(fingers)},
        course,
        float(np.rad2deg(bound.angle)),
    )
    found += chart(f"smallest singular values{of}", track.singular_values, course)
    marks = [(shades[name], plain_name(name)) for name in shades if name]
    kinds = {one.kind for one in solve.events if one.kind in EVENT_COLORS}
    marks += [(EVENT_COLORS[kind], plain_name(kind.lower())) for kind in sorted(kinds)]
    return found + (legend(marks) if marks else "")
