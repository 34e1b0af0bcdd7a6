"""The state of a training in a file, from which it goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from grr_torch.errors import FileFormatError
from grr_torch.output import atomic_write
from grr_torch.resolution.roadmap_file import tensors_hash
from grr_torch.tensor_file import read_tensor_file

FORMAT = "grr-torch training"
FORMAT_VERSION = 1


def checkpoint_path(out: str | os.PathLike[str]) -> Path:
    """Where the state of a training lies whose result is written to `out`."""
    path = Path(out)
    return path.with_name(f"{path.stem}.checkpoint{path.suffix}")


def save_checkpoint(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Writes a state, by an atomic rename: the one before stays until then.

    Raises:
        OutputError: It cannot be written.
    """
    kept = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    header = {"format": FORMAT, "format_version": FORMAT_VERSION, "tensors_sha256": tensors_hash(kept), **metadata}
    with atomic_write(path) as temporary:
        save_file(kept, temporary, metadata={key: json.dumps(value) for key, value in header.items()})


def load_checkpoint(path: Path, identity: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Reads a state.

    Args:
        path: The file.
        identity: Metadata that it must have: those of the training that goes on.

    Raises:
        FileFormatError: It is missing, truncated, damaged, or of another training.
    """
    metadata, tensors = read_tensor_file(path, FORMAT, FORMAT_VERSION, "a state of a training")
    wanted = json.loads(json.dumps(dict(identity)))
    others = [name for name, value in _flat(wanted).items() if _flat(metadata).get(name) != value]
    if others:
        raise FileFormatError(path, f"is of a training with other {', '.join(others)}")
    if tensors_hash(tensors) != metadata.get("tensors_sha256") or not {"epoch", "best"} <= set(metadata):
        raise FileFormatError(path, "holds another state than was written")
    return metadata, tensors


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """The values of the dictionaries in a dictionary, by their names."""
    flat: dict[str, Any] = {}
    for group in ("options", "origin"):
        flat.update({name.replace("_", " "): value for name, value in dict(data.get(group, {})).items()})
    return flat
