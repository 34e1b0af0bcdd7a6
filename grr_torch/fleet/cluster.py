"""Clusters of Ray: one that answers is joined, or one is started on this machine and ended with the work."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from grr_torch.errors import GrrError, MissingPackageError, ParameterError

if TYPE_CHECKING:
    from types import ModuleType

# seconds that an address has to take a connection, and then to answer as a cluster
_CONNECT, _ANSWER = 5.0, 20.0
# for a cluster started here: nothing is sent to anyone, and it listens on the loopback interface alone
_PRIVATE = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
_SHARED_MEMORY = 1 << 28
_PROBE = (
    "import sys, ray; ray.init(address=sys.argv[1], log_to_driver=False, logging_level='ERROR'); "
    "ray.cluster_resources(); ray.shutdown()"
)


@contextmanager
def cluster(address: str | None = None, *, cpus: int | None = None) -> Iterator[ModuleType]:
    """Gives Ray, connected; what was started or joined here is left at the end.

    Args:
        address: host:port of a running cluster, or "auto": the one that runs on this machine. None: the cluster that
            this process is in already, or else a new one on this machine.
        cpus: Cores of a new one; all by default.

    Raises:
        MissingPackageError: Ray is not installed.
        ParameterError: No cluster answers at the address, or this process is in one already.
    """
    ray = _import_ray()
    if ray.is_initialized():
        for name, value in (("address", address), ("cpus", cpus)):
            if value is not None:
                raise ParameterError(name, value, "none: this process is in a cluster already")
        yield ray
        return
    if address is None:
        with _own_cluster(ray, cpus):
            yield ray
        return
    check_answers(address)
    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    try:
        yield ray
    finally:
        ray.shutdown()


def _import_ray() -> Any:
    """Ray, so that clusters it starts are private.

    Raises:
        MissingPackageError: It is not installed.
    """
    for name, value in _PRIVATE.items():
        os.environ.setdefault(name, value)  # read when Ray is imported, and by the processes that it starts
    try:
        import ray
    except ImportError as error:
        raise MissingPackageError("ray", "cluster", "the engine ray") from error
    return ray


@contextmanager
def _own_cluster(ray: Any, cpus: int | None) -> Iterator[None]:
    # the names of sockets are short: a folder of the user's could be too long for them
    folder = tempfile.mkdtemp(prefix="grr-ray-", dir="/tmp" if os.path.isdir("/tmp") else None)
    try:
        ray.init(
            address="local",
            num_cpus=cpus,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            object_store_memory=_SHARED_MEMORY,
            _temp_dir=folder,
        )
        if ray.util.get_node_ip_address() not in ("127.0.0.1", "::1"):
            raise GrrError("Ray was imported before grr_torch.fleet.cluster and would listen to other machines")
        yield
    finally:
        ray.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def check_answers(address: str) -> None:
    """Finds out in seconds whether a cluster answers: Ray itself would wait for minutes.

    Raises:
        ParameterError: It is no address, or nothing answers as a cluster there.
    """
    if address != "auto":
        host, _, port = address.rpartition(":")
        if not host or "/" in host or not port.isdigit() or not 0 < int(port) < 1 << 16:
            raise ParameterError("address", repr(address), "host:port of a Ray cluster, or auto")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT).close()
        except OSError as error:
            reason = f"within {_CONNECT:g} s" if isinstance(error, TimeoutError) else f"({error.strerror or error})"
            raise ParameterError("address", address, f"a Ray cluster: nothing answers there {reason}") from error
    try:
        # in a process of its own, as a connection that hangs cannot be given up
        subprocess.run(
            [sys.executable, "-c", _PROBE, address], check=True, capture_output=True, text=True, timeout=_ANSWER
        )
    except subprocess.TimeoutExpired as error:
        reason = f"what is there does not answer as one within {_ANSWER:g} s"
        raise ParameterError("address", address, f"a Ray cluster: {reason}") from error
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines() or ["it gave no reason"]
        raise ParameterError("address", address, f"a Ray cluster: {lines[-1]}") from error
