"""Running a sweep: what is missing in a folder is built by an engine, and the catalogue is written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from grr_torch.errors import OutputError
from grr_torch.fleet.catalogue import CATALOGUE, Row, forget_failure, is_there, record_failure, write_catalogue
from grr_torch.fleet.order import Order
from grr_torch.fleet.work import Work, make_roadmap
from grr_torch.output import check_writable, lock_folder, remove_partial
from grr_torch.progress import Progress, silent

# told of each order that ended, and why it failed, or None
Told = Callable[[Order, str | None], None]


class Engine(Protocol):
    """What builds orders, wherever it does so."""

    def run(self, orders: Sequence[Order], folder: Path, told: Told, progress: Progress) -> None:
        """Makes the files of all orders in a folder. An order that fails is told of, and the rest goes on."""


class LocalEngine:
    """One order after the other, in this process."""

    def __init__(self, work: Work = make_roadmap) -> None:
        """An engine.

        Args:
            work: What makes an order's file.
        """
        self.work = work

    def run(self, orders: Sequence[Order], folder: Path, told: Told, progress: Progress) -> None:
        """Makes the files of all orders."""
        for number, order in enumerate(orders):
            progress("roadmaps", number, len(orders))
            try:
                self.work(order, folder, progress)
            except Exception as error:  # whatever it is, it is this order's failure alone
                told(order, f"{type(error).__name__}: {error}")
            else:
                told(order, None)
        progress("roadmaps", len(orders), len(orders))


def run_sweep(
    orders: Sequence[Order], folder: Path, engine: Engine, *, told: Told | None = None, progress: Progress = silent
) -> list[Row]:
    """Builds what is missing of a fleet in a folder, and writes its catalogue.

    What is there stays as it is; what failed in an earlier run is tried again. However a run ends, the files that it
    finished are whole, and the next run does the rest.

    Args:
        orders: The fleet's roadmaps.
        folder: Where the files go; made if it is absent. Machines of a cluster must all see it by this path.
        engine: What builds them.
        told: Called when an order has ended.
        progress: Told how far it is.

    Returns:
        The rows of these orders in the catalogue.

    Raises:
        OutputError: The folder cannot be written, or another sweep is at work there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(folder, str(error.strerror or error)) from error
    folder = folder.resolve()
    check_writable(folder / CATALOGUE)

    def write_down(order: Order, error: str | None) -> None:
        if error is None and not is_there(order, folder):
            error = f"its file is not in {folder}: all machines must see this folder by the same path"
        if error is None:
            forget_failure(order, folder)
        else:
            record_failure(order, folder, error)
        if told is not None:
            told(order, error)

    with _alone(folder):
        try:
            missing = [order for order in orders if not is_there(order, folder)]
            if missing:
                engine.run(missing, folder, write_down, progress)
        finally:
            rows = write_catalogue(folder)
    wanted = {order.hash for order in orders}
    return [row for row in rows if row["hash"] in wanted]


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keeps other sweeps out of a folder, and removes what a killed one left half written.

    Raises:
        OutputError: Another one is at work there.
    """
    handle = lock_folder(folder, "sweep")
    try:
        remove_partial(folder)
        yield
    finally:
        if handle is not None:
            os.close(handle)
