"""The state of a training in a file, from which it goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from grr_torch.errors import FileFormatError
from grr_torch.tensor_file import read_tensor_file, tensors_hash, write_tensors

FORMAT = "grr-torch training"
FORMAT_VERSION = 1


def checkpoint_path(out: str | os.PathLike[str]) -> Path:
    """Where the state of a training lies whose result is written to `out`."""
    path = Path(out)
    return path.with_name(f"{path.stem}.checkpoint{path.suffix}")


@dataclass(frozen=True)
class Checkpoint:
    """The file in which a training keeps its state.

    Attributes:
        path: The file.
        identity: What tells this training from others: its options, and what its network is for.
    """

    path: Path
    identity: Mapping[str, Any]

    def save(self, tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> None:
        """Writes a state, by an atomic rename: the one before stays until then.

        Raises:
            OutputError: It cannot be written.
        """
        kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        header = {"format": FORMAT, "format_version": FORMAT_VERSION, "tensors_sha256": tensors_hash(kept)}
        metadata = {**header, **progress, **self.identity}
        write_tensors(self.path, kept, {key: json.dumps(value) for key, value in metadata.items()})

    def load(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Reads a state: its metadata and tensors.

        Raises:
            FileFormatError: It is missing, truncated, damaged, or of another training.
        """
        if not self.path.exists():
            raise FileFormatError(self.path, "is not a file: the training has ended, or was never begun")
        metadata, tensors = read_tensor_file(self.path, FORMAT, FORMAT_VERSION, "a state of a training")
        wanted, found = _flat(json.loads(json.dumps(dict(self.identity)))), _flat(metadata)
        others = [name for name, value in wanted.items() if found.get(name) != value]
        if others:
            differ = ", ".join(f"{name} (there {found.get(name)!r}, here {wanted[name]!r})" for name in others)
            raise FileFormatError(self.path, f"is of a training with other {differ}")
        if tensors_hash(tensors) != metadata.get("tensors_sha256") or not {"epoch", "best"} <= set(metadata):
            raise FileFormatError(self.path, "holds another state than was written")
        return metadata, tensors


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """The values of the dictionaries in a dictionary, by their names."""
    flat: dict[str, Any] = {}
    for group in ("options", "origin"):
        flat.update({name.replace("_", " "): value for name, value in dict(data.get(group, {})).items()})
    return flat
