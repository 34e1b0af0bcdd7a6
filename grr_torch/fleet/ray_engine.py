"""The engine ray: orders as tasks of a Ray cluster, with their needs declared."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from grr_torch.errors import GrrWarning
from grr_torch.fleet.cluster import cluster
from grr_torch.fleet.order import Needs, Order
from grr_torch.fleet.run import Told
from grr_torch.fleet.work import Work, make_roadmap
from grr_torch.progress import Progress, silent

# how often an order is begun, whose worker is lost
_ATTEMPTS = 3
# seconds between two looks at an interrupt
_PATIENCE = 0.5


class RayEngine:
    """Tasks of a Ray cluster. One whose worker is lost is begun again; one that fails is not."""

    def __init__(self, address: str | None = None, *, cpus: int | None = None, work: Work = make_roadmap) -> None:
        """An engine.

        Args:
            address: host:port of a cluster, or "auto"; by default one is started on this machine, for as long as it is
                needed.
            cpus: Cores of that one; all by default.
            work: What makes an order's file.
        """
        self.address, self.cpus, self.work = address, cpus, work

    def run(self, orders: Sequence[Order], folder: Path, told: Told, progress: Progress) -> None:
        """Makes the files of all orders.

        Raises:
            MissingPackageError: Ray is not installed.
            ParameterError: No cluster answers at the address.
        """
        with cluster(self.address, cpus=self.cpus) as ray:
            self._run(ray, orders, folder, told, progress)

    def _run(self, ray: Any, orders: Sequence[Order], folder: Path, told: Told, progress: Progress) -> None:
        # attempts are counted here, as Ray's own never end where memory runs out
        task = ray.remote(max_retries=0)(_task)
        attempts = dict.fromkeys((order.hash for order in orders), 0)
        running: dict[Any, Order] = {}

        def begin(order: Order) -> None:
            attempts[order.hash] += 1
            named = task.options(**_resources(order.needs), name=f"roadmap {order.hash[:8]}")
            running[named.remote(self.work, order, str(folder))] = order

        for order in orders:
            lacking = _lacking(ray, order.needs)
            if lacking and self.address is None:
                told(order, f"no machine of the cluster has {lacking}")
            else:
                if lacking:
                    text = f"{order.label}: no machine of the cluster has {lacking} now; it waits for one"
                    warnings.warn(text, GrrWarning, stacklevel=2)
                begin(order)
        total, done = len(orders), len(orders) - len(running)
        try:
            while running:
                progress("roadmaps", done, total)
                for reference in ray.wait(list(running), timeout=_PATIENCE)[0]:
                    order = running.pop(reference)
                    error, lost = _outcome(ray, reference)
                    if lost and attempts[order.hash] < _ATTEMPTS:
                        left = _ATTEMPTS - attempts[order.hash]
                        warnings.warn(
                            f"{order.label}: {error}; begun again, at most {left} times", GrrWarning, stacklevel=2
                        )
                        begin(order)
                        continue
                    done += 1
                    told(order, f"{error}, {_ATTEMPTS} times" if lost else error)
            progress("roadmaps", total, total)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)


def _task(work: Work, order: Order, folder: str) -> str | None:
    """Makes an order's file on a worker; gives what it failed by, as text: errors need not travel."""
    try:
        work(order, Path(folder), silent)
    except Exception as error:  # whatever it is, it is this order's failure alone
        return f"{type(error).__name__}: {error}"
    return None


def _outcome(ray: Any, reference: Any) -> tuple[str | None, bool]:
    """Why a task failed, or None, and whether its worker was lost."""
    try:
        return ray.get(reference), False
    except ray.exceptions.OutOfMemoryError:
        return "its worker was ended because the machine ran out of memory", True
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError):
        return "its worker died", True
    except ray.exceptions.RayError as error:
        return f"{type(error).__name__}: {str(error).strip().splitlines()[-1]}", False


def _resources(needs: Needs) -> dict[str, float]:
    """Needs as Ray takes them."""
    return {"num_cpus": needs.cpus, "num_gpus": needs.gpus, "memory": int(needs.memory * 2**30)}


def _lacking(ray: Any, needs: Needs) -> str:
    """What no single machine of a cluster has of some needs, in words; empty if one has it all."""
    wanted = {"CPU": needs.cpus, "memory": needs.memory * 2**30, "GPU": needs.gpus}
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(all(machine.get(name, 0.0) >= value for name, value in wanted.items()) for machine in machines):
        return ""
    return f"{needs.cpus:g} cores, {needs.memory:g} GiB and {needs.gpus:g} GPUs"
