"""Base classes of pages, their worker thread, and undo."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec

from casadi_ik.app.viewer.access import Server
from casadi_ik.app.viewer.camera import set_up_scene
from casadi_ik.app.viewer.panel import on_press
from casadi_ik.app.viewer.request import PageRequest
from casadi_ik.compile.cancellation import CancelledError, cancellable
from casadi_ik.errors import shortened
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

UNDO_LIMIT = 200
"""Maximum number of steps that can be undone."""


P = ParamSpec("P")


def on_page_thread(
    method: Callable[Concatenate[Any, P], None],
) -> Callable[Concatenate[Any, P], None]:
    """Run a method on the worker thread of its page instead of a thread of the server.

    Of several pending calls of one method only the latest is run.
    """

    @wraps(method)
    def submit(page: Page, *args: P.args, **options: P.kwargs) -> None:
        page.work.submit(method.__name__, partial(method, page, *args, **options))

    return submit


class Page:
    """A scene and a panel; both are changed by the worker thread only.

    Attributes:
        server: Server of the page.
        work: Worker thread.
        on_replaced: Callback that receives the page that replaces this one.
    """

    on_replaced: Callable[[Page], None]

    def __init__(self, server: Server, title: str, floor: float, dark: bool | None) -> None:
        """Replace the content of the server by an empty page.

        Args:
            server: Server of the page.
            title: Title of the panel and of the browser's tab.
            floor: Height of the ground [m].
            dark: Use the dark theme; None: follow the first browser that opens the page.
        """
        self.server, self.dark, self.is_stopped = server, bool(dark), False
        self._title_and_floor = title, floor
        self._theme_box: Any = None
        server.access.on_dark_theme = self.set_theme if dark is None else None
        set_up_scene(server, title, floor, self.dark)

    def start(self, *idle_tasks: tuple[float, Task]) -> None:
        """Start the worker thread; for `idle_tasks` see `LatestOnly`."""
        self.work = LatestOnly(lambda: None if self.is_stopped else self.refresh(), idle_tasks)

    def refresh(self) -> None:
        """Draw the current state."""
        raise NotImplementedError

    def stop(self) -> None:
        """Stop the worker thread."""
        self.is_stopped = True
        self.work.stop()

    selection = ""

    def select(self, name: str) -> None:
        """Show the handles of an item, on pages that have handles."""

    def set_theme(self, dark: bool) -> None:
        """Use the dark or the light theme."""
        self.dark, self.server.access.on_dark_theme = dark, None
        set_up_scene(self.server, *self._title_and_floor, dark)
        if self._theme_box is not None and self._theme_box.value != dark:
            self._theme_box.value = dark

    def add_theme_switch(self) -> None:
        """Add a switch between the light and the dark theme."""
        box = self.server.gui.add_checkbox("Dark", self.dark)
        self._theme_box = box

        @box.on_update
        async def _(_: Any) -> None:
            if box.value != self.dark:
                self.set_theme(box.value)


class InteractivePage(Page):
    """A page with draggable contacts and undo.

    Attributes:
        robot: The robot.
        request: Current request.
        selection: Item whose handles are shown; "": none.
    """

    def __init__(
        self,
        server: Server,
        robot: ArmHand,
        request: PageRequest,
        title: str,
        floor: float,
        dark: bool | None,
    ) -> None:
        """Make an empty page, see `Page`."""
        super().__init__(server, title, floor, dark)
        self.robot, self.request, self._dragged = robot, request, ""
        self.selection = ""
        self._undo_stack: list[Any] = []
        self._redo_stack: list[Any] = []

    def start(self, *idle_tasks: tuple[float, Task]) -> None:
        """Start the worker thread; the current state is the first one of the undo stack."""
        self._undo_stack = [self.state()]
        super().start(*idle_tasks, (IDLE_DELAY, self.push_undo))

    def drag(self, name: str, pose: Array) -> None:
        """Move a contact, the object or a scene item to a (4, 4) pose."""
        self.change(name, lambda request: request.with_pose(name, pose), name)

    def drag_point(self, finger: str, point: Array) -> None:
        """Move a contact to a point (3,) [m]."""
        self.change(finger, lambda request: request.with_point(finger, point))

    def drag_normal(self, finger: str, normal: Array) -> None:
        """Rotate a contact to a normal (3,)."""
        self.change(finger, lambda request: request.with_normal(finger, normal))

    def change(
        self, key: str, edit: Callable[[PageRequest], PageRequest], dragged: str = ""
    ) -> None:
        """Edit the request; of several pending edits of a key only the latest is applied.

        Args:
            key: Key of the edit.
            edit: Function from the current request to the new one.
            dragged: Item that the browser has moved already.
        """

        def apply_edit() -> None:
            self.on_request_change()
            self.request, self._dragged = edit(self.request), dragged

        self.work.submit(key, apply_edit)

    @on_page_thread
    def select(self, name: str) -> None:
        """Show the handles of an item; "" hides all handles."""
        self.selection = name
        self.show_selection(name)

    @on_page_thread
    def undo(self) -> None:
        """Undo the last step."""
        self.push_undo()
        if len(self._undo_stack) > 1:
            self._redo_stack.append(self._undo_stack.pop())
            self.restore(self._undo_stack[-1])

    @on_page_thread
    def redo(self) -> None:
        """Redo the last step that was undone."""
        self.push_undo()
        if self._redo_stack:
            self._undo_stack.append(self._redo_stack.pop())
            self.restore(self._undo_stack[-1])

    @on_page_thread
    def reset(self) -> None:
        """Restore the initial state; this can be undone."""
        self.push_undo()
        self.restore(self._undo_stack[0])

    def add_undo_buttons(self) -> None:
        """Add buttons and keys for undo and redo, and a button for reset."""
        buttons = self.server.gui.add_button_group("Steps", ("Undo", "Redo", "Reset"))
        actions = {"Undo": self.undo, "Redo": self.redo, "Reset": self.reset}
        on_press(buttons, lambda _: actions[str(buttons.value)]())
        add_command = self.server.gui.add_command
        undo_command = add_command("Undo", hotkey="Z", modifier="cmd/ctrl")
        redo_command = add_command("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        for command, action in ((undo_command, self.undo), (redo_command, self.redo)):

            @command.on_trigger
            async def _(_: Any, action: Task = action) -> None:
                action()

    # Hooks of subclasses.

    def on_request_change(self) -> None:
        """Prepare for a new request."""

    def show_selection(self, name: str) -> None:
        """Show the handles of the selected item."""

    def state(self) -> tuple[PageRequest, *tuple[Any, ...]]:
        """Return an immutable state for the undo stack; the request comes first."""
        return (self.request,)

    def restore(self, state: tuple[PageRequest, *tuple[Any, ...]]) -> None:
        """Restore a state."""
        self.on_request_change()
        self.request = state[0]

    def push_undo(self) -> None:
        """Push the current state on the undo stack if the request has changed."""
        state = self.state()
        if state[0] is not self._undo_stack[-1][0]:
            self._undo_stack = [self._undo_stack[0], *self._undo_stack[1:], state][-UNDO_LIMIT:]
            self._redo_stack.clear()


logger = logging.getLogger(__name__)

Task = Callable[[], None]

SHORT_DELAY = 0.02
"""Delay of tasks that follow a drag without delaying its solve [s]."""

IDLE_DELAY = 0.15
"""Time without changes after which a drag has ended [s]; during one, changes are 0.05 s apart."""

LONG_IDLE_DELAY = 0.5
"""Time without changes after which slow tasks start [s]."""

MAX_WARNINGS = 20
"""Maximum number of distinct errors that are logged as warnings."""


class LatestOnly:
    """Worker thread that applies the latest change of each key, refreshes, and runs idle tasks.

    A drag sends twenty changes a second, independently of the time of a solve. Each change has a
    key; a pending change is dropped when another change with its key arrives. Idle tasks start
    after a time without changes, and are cancelled by a new change. Threads of the server only
    submit changes.
    """

    def __init__(self, refresh: Task, idle_tasks: tuple[tuple[float, Task], ...] = ()) -> None:
        """Start the thread.

        Args:
            refresh: Function called once after all pending changes.
            idle_tasks: Pairs of a time without changes [s], in ascending order, and the task that
                then starts. The tasks are repeated after the next change.
        """
        self._refresh, self._idle_tasks = refresh, idle_tasks
        self._changes: dict[str, Task] = {}
        self._condition = threading.Condition()
        self._busy = self._stopped = False
        self._waiter_count = 0
        self._new_change = threading.Event()
        self._logged: set[str] = set()
        self.dropped_count = 0
        self._thread = threading.Thread(target=self._run, name="casadi-ik view", daemon=True)
        self._thread.start()

    def submit(self, key: str, change: Task) -> None:
        """Submit a change without waiting for it."""
        with self._condition:
            if self._changes.pop(key, None) is not None:
                self.dropped_count += 1
            self._changes[key] = change
            self._new_change.set()
            self._condition.notify_all()

    def settle(self, seconds: float = 30.0) -> bool:
        """Wait until all changes and idle tasks are done; returns False after a timeout."""
        with self._condition:
            self._waiter_count += 1
            self._condition.notify_all()
            try:
                return self._condition.wait_for(lambda: not (self._busy or self._changes), seconds)
            finally:
                self._waiter_count -= 1

    def stop(self) -> None:
        """Stop the thread after the current task."""
        with self._condition:
            self._stopped = True
            self._new_change.set()
            self._condition.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _run(self) -> None:
        while self._wait_for_changes():
            for change in self._take_changes():
                self._run_task(change)
            self._run_task(self._refresh)
            self._run_idle_tasks(time.monotonic())

    def _run_idle_tasks(self, since: float) -> None:
        try:
            with cancellable(self._new_change):
                for delay, task in self._idle_tasks:
                    if not self._stays_idle(since + delay):
                        return
                    self._run_task(task)
        except CancelledError:
            logger.debug("idle task cancelled by a new change")

    def _stays_idle(self, until: float) -> bool:
        """Wait until a time; return False if a change arrives, True early for `settle`."""
        with self._condition:
            self._condition.wait_for(
                lambda: self._changes or self._stopped or self._waiter_count,
                timeout=max(until - time.monotonic(), 0.0),
            )
            return not (self._changes or self._stopped)

    def _wait_for_changes(self) -> bool:
        with self._condition:
            self._busy = False
            self._condition.notify_all()
            self._condition.wait_for(lambda: self._changes or self._stopped)
            self._busy = True
            return not self._stopped

    def _take_changes(self) -> list[Task]:
        with self._condition:
            changes = list(self._changes.values())
            self._changes.clear()
            if not self._stopped:
                self._new_change.clear()
        return changes

    def _run_task(self, task: Task) -> None:
        try:
            task()
        except Exception as error:
            # An error must not end the page, nor be logged at every movement.
            message = shortened(f"{type(error).__name__}: {error}").partition("\n")[0]
            first = message not in self._logged and len(self._logged) < MAX_WARNINGS
            self._logged.add(message)
            level = logging.WARNING if first else logging.DEBUG
            debugged = logger.isEnabledFor(logging.DEBUG)
            logger.log(level, "viewer: change failed: %s", message, exc_info=debugged)
