"""The control loop of a session."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event

from grr_torch.applications.teleoperation_log import Step
from grr_torch.interactive.session import Session


def drive(session: Session, show: Callable[[Step], None], stop: Event) -> None:
    """Lets a session tick at its rate until it is stopped.

    A step that comes late is not made up for: the arm then moves more slowly, never faster.

    Args:
        session: The session.
        show: Told of every step; it must not wait.
        stop: Ends the loop.
    """
    period = 1.0 / session.rate
    start = time.perf_counter()
    while not stop.is_set():
        begun = time.perf_counter()
        show(session.tick(begun - start))
        stop.wait(max(begun + period - time.perf_counter(), 0.0))
