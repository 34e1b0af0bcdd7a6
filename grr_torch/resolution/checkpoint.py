"""Checkpoints of a build: what it has done so far, in files, so that it goes on from there when it was killed.

A folder holds what determines the build (`build.json`) and a file for each stage, in their order. Stages are finished
one after the other, so the last file alone may be of one that is under way. All files appear whole, by renaming. When
the build is finished, its roadmap (`roadmap.grr`) takes their place.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from grr_torch.errors import FileFormatError, GrrWarning, OutputError
from grr_torch.output import PARTIAL, atomic_write, lock_folder, remove_partial
from grr_torch.tensor_file import read_tensors, tensor_hash, write_tensors

# a stage that is under way is written no sooner after the last time [s]
_INTERVAL = 10.0
# nor sooner than so many times what it took to write
_PATIENCE = 20.0
_BUILD, _ROADMAP = "build.json", "roadmap.grr"


@dataclass(frozen=True)
class Stage:
    """One stage of a build, and where it is kept.

    Attributes:
        checkpoint: What it belongs to; None if nothing is kept.
        path: Its file.
        found: What an earlier run has kept of it.
    """

    checkpoint: Checkpoint | None
    path: Path
    found: Mapping[str, Tensor]

    def state(self) -> dict[str, Tensor]:
        """What the stage had come to, for its own use; empty if it has not begun."""
        return {name: tensor.clone() for name, tensor in self.found.items()}

    def keep(self, state: Mapping[str, Tensor], *, last: bool = False) -> None:
        """Writes what the stage has come to, if it is the last of it or nothing was written for a while.

        Args:
            state: What `state` is to give to a later run.
            last: Whether the stage is finished.

        Raises:
            OutputError: It cannot be written.
        """
        if self.checkpoint is not None and (last or self.checkpoint.is_due()):
            self.checkpoint.write(self.path, state)


class Checkpoint:
    """What a build has done so far. Without a folder, nothing is kept.

    Attributes:
        folder: Where it is kept, or None.
        roadmap: The file of the finished roadmap, if the build was finished.
    """

    def __init__(
        self, folder: str | os.PathLike[str] | None = None, build: Mapping[str, Any] | None = None, resume: bool = False
    ) -> None:
        """Opens a folder, or makes it.

        Args:
            folder: An absent or empty one starts afresh.
            build: All that determines the result, by name; values are JSON.
            resume: Whether to go on from what is there.

        Raises:
            OutputError: The folder holds anything and `resume` is false, another build uses it, or it cannot be
                written.
            FileFormatError: What is there is no checkpoint, of another build, or corrupt.
        """
        self.folder = None if folder is None else Path(folder)
        self.roadmap: Path | None = None
        self._found: dict[str, dict[str, Tensor]] = {}
        self._stages = 0
        self._seconds: dict[str, float] = {}
        self._running: tuple[str, float] | None = None
        self._due = time.monotonic() + _INTERVAL
        self._lock: int | None = None
        if self.folder is not None:
            try:
                self._open(self.folder, json.loads(json.dumps(build)), resume)
            except BaseException:
                self.close()
                raise

    def close(self) -> None:
        """Lets another build use the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def stage(self, name: str) -> Stage:
        """The next stage; a build asks for the same ones in the same order whenever it runs."""
        self._stages += 1
        if self.folder is None:
            return UNKEPT
        path = self.folder / f"{self._stages:02d}-{name}.safetensors"
        return Stage(self, path, self._found.pop(path.name, {}))

    def once(self, name: str, compute: Callable[[], Mapping[str, Tensor]]) -> Mapping[str, Tensor]:
        """A stage that is kept only as a whole: what `compute` gives, or gave to an earlier run."""
        stage = self.stage(name)
        found: Mapping[str, Tensor] = stage.state()
        if not found:
            found = compute()
            stage.keep(found, last=True)
        return found

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Counts the time of a block as time spent on something, that of earlier runs included."""
        self._running = what, time.perf_counter() - self._seconds.get(what, 0.0)
        try:
            yield
        finally:
            self._seconds, self._running = self._clock(), None

    def seconds(self, what: str) -> float:
        """How long something took, over all runs [s]."""
        return self._clock().get(what, 0.0)

    def finish(self, save: Callable[[Path], None]) -> None:
        """Puts the roadmap that `save` writes in the place of all stages."""
        if self.folder is not None:
            save(self.folder / _ROADMAP)
            for path in self.folder.glob("*.safetensors"):
                path.unlink()

    def is_due(self) -> bool:
        """Whether it is time to write again."""
        return time.monotonic() >= self._due

    def write(self, path: Path, tensors: Mapping[str, Tensor]) -> None:
        """Writes the file of a stage."""
        begin = time.monotonic()
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        hashes = {name: tensor_hash(tensor) for name, tensor in tensors.items()}
        write_tensors(path, tensors, {"tensors_sha256": json.dumps(hashes), "seconds": json.dumps(self._clock())})
        end = time.monotonic()
        self._due = end + max(_INTERVAL, _PATIENCE * (end - begin))

    def _clock(self) -> dict[str, float]:
        if self._running is None:
            return self._seconds
        what, begin = self._running
        return {**self._seconds, what: time.perf_counter() - begin}

    def _open(self, folder: Path, build: dict[str, Any], resume: bool) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock_folder(folder, "build")
            partial = set(folder.glob(PARTIAL))  # of a run that was killed
            present = sorted(path.name for path in folder.iterdir() if path not in partial)
        except OSError as error:
            raise OutputError(folder, str(error.strerror or error)) from error
        if not present:
            with atomic_write(folder / _BUILD) as temporary:
                temporary.write_text(json.dumps(build, indent=2), encoding="utf-8")
            return
        if not resume:
            raise OutputError(folder, "it is not empty; valid: another folder, or --resume to go on from what is there")
        _check_build(folder / _BUILD, build)
        remove_partial(folder)
        if _ROADMAP in present:
            self.roadmap = folder / _ROADMAP
            _read_whole(self.roadmap)
            return
        self._read(sorted(folder.glob("[0-9][0-9]-*.safetensors")))

    def _read(self, paths: list[Path]) -> None:
        """Takes the files of stages up to the first one that is corrupt."""
        for path in paths:
            try:
                metadata, tensors = _read_whole(path)
            except FileFormatError as error:
                if path == paths[0]:
                    raise FileFormatError(path, f"{error.reason}; nothing older is there to go on from") from error
                warnings.warn(f"{error}; going on from {paths[len(self._found) - 1].name}", GrrWarning, stacklevel=4)
                return
            self._found[path.name], self._seconds = tensors, json.loads(metadata["seconds"])


def _read_whole(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a file.

    Raises:
        FileFormatError: It is missing, truncated, or its tensors are not those that were written.
    """
    metadata, tensors = read_tensors(path, "a checkpoint")
    hashes = {name: tensor_hash(tensor) for name, tensor in tensors.items()}
    if json.loads(metadata.get("tensors_sha256", "null")) != hashes:
        raise FileFormatError(path, "is corrupt: its tensors do not fit their SHA-256")
    return metadata, tensors


def digest(value: Any) -> str:
    """SHA-256 of a JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _check_build(path: Path, build: Mapping[str, Any]) -> None:
    """Checks that a folder's checkpoint is of this very build.

    Raises:
        FileFormatError: It is not.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileFormatError(path.parent, "holds other files, and no checkpoint; valid: an empty folder") from error
    except (OSError, ValueError) as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    if not isinstance(stored, dict):
        raise FileFormatError(path, "is not the description of a build")
    differing = [name for name in {**build, **stored} if build.get(name) != stored.get(name)]
    if differing:
        told = ", ".join(
            f"{name} ({_short(stored.get(name))} there, {_short(build.get(name))} here)" for name in differing
        )
        raise FileFormatError(path.parent, f"is the checkpoint of another build: it differs in {told}")


def _short(value: Any) -> str:
    text = str(value)
    return f"{text[:12]}…" if len(text) > 40 else text


# a stage of which nothing is kept
UNKEPT = Stage(None, Path(), {})
