"""What all pages have: a title, a look, a thread for changes; what is dragged, and taken back."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec

from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.panel import on_press
from casadi_ik.app.viewer.request import PageRequest
from casadi_ik.app.viewer.viser_scene import set_stage
from casadi_ik.compile.cancellation import CancelledError, cancellable
from casadi_ik.errors import shortened
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

KEPT = 200
"""Steps that can be taken back."""


P = ParamSpec("P")


def in_turn(method: Callable[Concatenate[Any, P], None]) -> Callable[Concatenate[Any, P], None]:
    """A page's method that a browser asks for: put down, done by the page's thread in its turn.

    Of several calls that wait the newest counts.
    """

    @wraps(method)
    def put(page: Page, *args: P.args, **named: P.kwargs) -> None:
        page.work.put(method.__name__, partial(method, page, *args, **named))

    return put


class Page:
    """What is drawn, and a panel beside it; all of it belongs to the thread of `work`.

    Attributes:
        server: What serves it.
        work: What everything is done by.
        opened: Told of the page that takes the place of this one.
    """

    opened: Callable[[Page], None]

    def __init__(self, server: Server, title: str, floor: float, dark: bool) -> None:
        """An empty page in the place of what was there.

        Args:
            server: What serves it.
            title: On the panel and on the browser's tab.
            floor: Height of the ground [m].
            dark: Whether it is dark.
        """
        self.server, self.dark, self.ended = server, dark, False
        self._stage = title, floor
        set_stage(server, title, floor, dark)

    def begin(self, *later: tuple[float, Work]) -> None:
        """Start its thread; `later`: what is done once nothing moves, see `Newest`."""
        self.work = Newest(lambda: None if self.ended else self.refresh(), later)

    def refresh(self) -> None:
        """Draw what has changed."""
        raise NotImplementedError

    def stop(self) -> None:
        """End its thread."""
        self.ended = True
        self.work.stop()

    held = ""

    def select(self, name: str) -> None:
        """Give something its handles, on pages that have some."""

    def add_dark(self) -> None:
        """A switch between light and dark."""
        title, floor = self._stage
        box = self.server.gui.add_checkbox("Dark", self.dark)

        @box.on_update
        async def _(_: Any) -> None:
            self.dark = box.value
            set_stage(self.server, title, floor, box.value)


class DraggedPage(Page):
    """A page whose contacts are dragged, one after the other, and taken back.

    Attributes:
        robot: The robot.
        asked: What is asked now.
        held: What has handles; "": nothing.
    """

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        asked: PageRequest,
        title: str,
        floor: float,
        dark: bool,
    ) -> None:
        """An empty page, see `Page`."""
        super().__init__(server, title, floor, dark)
        self.robot, self.asked, self._dragged = robot, asked, ""
        self.held = ""
        self._past: list[Any] = []
        self._future: list[Any] = []

    def begin(self, *later: tuple[float, Work]) -> None:
        """Start its thread; where it stands is where everything can be taken back to."""
        self._past = [self.state()]
        super().begin(*later, (REST, self.remember))

    def drag(self, name: str, pose: Array) -> None:
        """A contact, the object or something in the scene dragged to a (4, 4) pose."""
        self.change(name, lambda asked: asked.moved(name, pose), name)

    def drag_point(self, finger: str, point: Array) -> None:
        """A contact dragged by its ball to a point (3,)."""
        self.change(finger, lambda asked: asked.with_point(finger, point))

    def drag_normal(self, finger: str, normal: Array) -> None:
        """A contact turned by its arrow to face a way (3,)."""
        self.change(finger, lambda asked: asked.with_normal(finger, normal))

    def change(
        self, key: str, change: Callable[[PageRequest], PageRequest], dragged: str = ""
    ) -> None:
        """Another request; of several changes of a key the newest counts.

        Args:
            key: What is changed.
            change: The request as it was to the request as it is.
            dragged: What the browser has moved already.
        """

        def work() -> None:
            self.changed_by_hand()
            self.asked, self._dragged = change(self.asked), dragged

        self.work.put(key, work)

    @in_turn
    def select(self, name: str) -> None:
        """Give something its handles; "" takes them all away."""
        self.held = name
        self.selected(name)

    @in_turn
    def undo(self) -> None:
        """Take the last step back."""
        self.remember()
        if len(self._past) > 1:
            self._future.append(self._past.pop())
            self.restore(self._past[-1])

    @in_turn
    def redo(self) -> None:
        """Do again what was taken back."""
        self.remember()
        if self._future:
            self._past.append(self._future.pop())
            self.restore(self._past[-1])

    @in_turn
    def reset(self) -> None:
        """Back to what was asked first; that can be taken back, too."""
        self.remember()
        self.restore(self._past[0])

    def add_steps(self) -> None:
        """Buttons that take steps back, do them again and begin anew; keys for the first two."""
        steps = self.server.gui.add_button_group("Steps", ("Undo", "Redo", "Reset"))
        do = {"Undo": self.undo, "Redo": self.redo, "Reset": self.reset}
        on_press(steps, lambda _: do[str(steps.value)]())
        add = self.server.gui.add_command
        back = add("Undo", hotkey="Z", modifier="cmd/ctrl")
        again = add("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        for command, work in ((back, self.undo), (again, self.redo)):

            @command.on_trigger
            async def _(_: Any, work: Work = work) -> None:
                work()

    # What its kinds do each in their way.

    def changed_by_hand(self) -> None:
        """What is asked is about to change."""

    def selected(self, name: str) -> None:
        """Show what has handles."""

    def state(self) -> tuple[PageRequest, *tuple[Any, ...]]:
        """What can be gone back to: what is asked, which is never changed in place, and more."""
        return (self.asked,)

    def restore(self, state: tuple[PageRequest, *tuple[Any, ...]]) -> None:
        """Go back to a state."""
        self.changed_by_hand()
        self.asked = state[0]

    def remember(self) -> None:
        """What stands now is a step."""
        state = self.state()
        if state[0] is not self._past[-1][0]:
            self._past = [self._past[0], *self._past[1:], state][-KEPT:]
            self._future.clear()


logger = logging.getLogger(__name__)

Work = Callable[[], None]

PAUSE = 0.02
"""What follows a drag waits so long, and so never is in the way of an answer [s]."""

REST = 0.15
"""After so long nothing moves any more [s]; in a drag, changes are 0.05 s apart."""

LOOKS = 0.5
"""After so long whoever drags looks, and does not go on at once [s]: time for what takes long."""

FAULTS = 20
"""So many different ones are told of."""


class Newest:
    """A thread that does the newest change of every key, then draws, then what can wait.

    Whoever drags sends twenty changes a second, whatever a solve takes. Each change has a key; one
    that was not begun when another of its key comes is dropped. What can wait is begun once nothing
    has come for a while, and given up when something comes. The thread that talks to the browsers
    only ever puts a change down.
    """

    def __init__(self, refresh: Work, later: tuple[tuple[float, Work], ...] = ()) -> None:
        """Start it.

        Args:
            refresh: Called after changes, once for all that were waiting.
            later: Each called once nothing has come for so long [s], the shortest first; all begun
                anew after the next change if that comes in between.
        """
        self._refresh, self._later = refresh, later
        self._changes: dict[str, Work] = {}
        self._something = threading.Condition()
        self._busy = self._stopped = False
        self._awaited = 0
        self._moved_on = threading.Event()
        self._told: set[str] = set()
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="casadi-ik view", daemon=True)
        self._thread.start()

    def put(self, key: str, change: Work) -> None:
        """Ask for a change; returns at once."""
        with self._something:
            if self._changes.pop(key, None) is not None:
                self.dropped += 1
            self._changes[key] = change
            self._moved_on.set()
            self._something.notify_all()

    def settle(self, seconds: float = 30.0) -> bool:
        """Wait until everything is done, what can wait as well; False if it takes longer."""
        with self._something:
            self._awaited += 1
            self._something.notify_all()
            try:
                return self._something.wait_for(lambda: not (self._busy or self._changes), seconds)
            finally:
                self._awaited -= 1

    def stop(self) -> None:
        """End the thread after what it is doing."""
        with self._something:
            self._stopped = True
            self._moved_on.set()
            self._something.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _run(self) -> None:
        while self._wait():
            for change in self._take():
                self._do(change)
            self._do(self._refresh)
            self._do_later(time.monotonic())

    def _do_later(self, since: float) -> None:
        try:
            with cancellable(self._moved_on):
                for pause, work in self._later:
                    if not self._rests(since + pause):
                        return
                    self._do(work)
        except CancelledError:
            logger.debug("given up for something newer")

    def _rests(self, until: float) -> bool:
        """Whether nothing comes until then; at once if somebody waits for everything."""
        with self._something:
            self._something.wait_for(
                lambda: self._changes or self._stopped or self._awaited,
                timeout=max(until - time.monotonic(), 0.0),
            )
            return not (self._changes or self._stopped)

    def _wait(self) -> bool:
        with self._something:
            self._busy = False
            self._something.notify_all()
            self._something.wait_for(lambda: self._changes or self._stopped)
            self._busy = True
            return not self._stopped

    def _take(self) -> list[Work]:
        with self._something:
            changes = list(self._changes.values())
            self._changes.clear()
            if not self._stopped:
                self._moved_on.clear()
        return changes

    def _do(self, work: Work) -> None:
        try:
            work()
        except Exception as error:
            # One thing that goes wrong must not end the page, nor be told at every movement.
            text = shortened(f"{type(error).__name__}: {error}").partition("\n")[0]
            first = text not in self._told and len(self._told) < FAULTS
            self._told.add(text)
            level = logging.WARNING if first else logging.DEBUG
            debugged = logger.isEnabledFor(logging.DEBUG)
            logger.log(level, "the view could not do what was asked: %s", text, exc_info=debugged)
