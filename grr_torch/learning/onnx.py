"""A trained network in formats of other programs: ONNX, and torch.export."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import MissingPackageError, OutputError
from grr_torch.learning.network import IkNetwork
from grr_torch.learning.neural_ik import Origin
from grr_torch.output import atomic_write

# largest difference between what is exported and the network, encoded by the cosine and sine of the angle between
_AGREE = 1e-4
_CHECKED = 257


def export_onnx(network: IkNetwork, origin: Origin, path: str | os.PathLike[str]) -> float:
    """Writes a network as ONNX: input `points` (N, d) float32 [m], output `configurations` (N, n) float32 [rad or m].

    Normalising and decoding are inside. The file is run with onnxruntime on random points before it appears.

    Returns:
        The largest difference from the network seen there [rad or m].

    Raises:
        MissingPackageError: onnx, onnxscript or onnxruntime is not installed.
        OutputError: It cannot be written, or does not give what the network gives.
    """
    runtime, onnx = _onnx_packages()
    network = copy.deepcopy(network).cpu().eval()
    points = torch.zeros(2, origin.task.width)
    dynamic = {"points": {0: torch.export.Dim("N", min=1)}}
    with _quiet():
        program: Any = torch.onnx.export(
            network,
            (points,),
            dynamo=True,
            verbose=False,
            input_names=["points"],
            output_names=["configurations"],
            dynamic_shapes=dynamic,
        )
    model = program.model_proto
    about = {**origin.to_dict(), "joint_names": list(origin.joint_names)}
    onnx.helper.set_model_props(model, {"grr_torch": json.dumps(about)})
    with atomic_write(path) as temporary:
        temporary.write_bytes(model.SerializeToString())
        session = runtime.InferenceSession(str(temporary), providers=["CPUExecutionProvider"])
        return _check(Path(path), network, lambda x: torch.from_numpy(session.run(None, {"points": x.numpy()})[0]))


def export_torch(network: IkNetwork, origin: Origin, path: str | os.PathLike[str]) -> float:
    """Writes a network with `torch.export` as a .pt2 file: points (N, d) to configurations (N, n), as in `export_onnx`.

    Returns:
        The largest difference from the network seen on random points [rad or m].

    Raises:
        OutputError: It cannot be written, or does not give what the network gives.
    """
    network = copy.deepcopy(network).cpu().eval()
    points = torch.zeros(2, origin.task.width)
    program = torch.export.export(network, (points,), dynamic_shapes={"points": {0: torch.export.Dim("N", min=1)}})
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={"grr_torch.json": json.dumps(origin.to_dict())})
    with atomic_write(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
        loaded = torch.export.load(io.BytesIO(buffer.getvalue())).module()
        return _check(Path(path), network, loaded)


def _check(path: Path, network: IkNetwork, exported: Any) -> float:
    """The largest difference [rad or m] on random points, in batches of several sizes."""
    generator = torch.Generator().manual_seed(0)
    encoding = network.encoding
    worst = 0.0
    with torch.no_grad():
        for count in (1, 2, _CHECKED):
            inputs = 2.0 * torch.rand(count, len(encoding.centre), generator=generator) - 1.0
            points = inputs * encoding.scale + encoding.centre
            expected, given = network(points), exported(points)
            worst = max(worst, float(_apart(expected, given, encoding.continuous)))
    if not worst <= _AGREE:
        raise OutputError(path, f"what was exported is {worst:.2g} rad from the network")
    return worst


def _apart(first: Tensor, second: Tensor, continuous: tuple[bool, ...]) -> Tensor:
    from grr_torch.spaces.configuration import difference

    return difference(first, second, torch.tensor(continuous)).abs().max()


def _onnx_packages() -> tuple[Any, Any]:
    """Onnxruntime and onnx; onnxscript is only asked for, as torch uses it."""
    found = {}
    for name in ("onnx", "onnxscript", "onnxruntime"):
        try:
            found[name] = __import__(name)
        except ImportError as error:
            raise MissingPackageError(name, "learn", "ONNX export") from error
    return found["onnxruntime"], found["onnx"]


@contextlib.contextmanager
def _quiet() -> Any:
    """Without what the exporter prints and logs."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
