"""Writing files so that nothing is lost: a temporary file beside the target, renamed when it is complete."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from grr_torch.errors import OutputError, ParameterError

try:
    import fcntl
except ImportError:  # where there are no POSIX locks, two users of one folder are not noticed
    fcntl = None  # type: ignore[assignment]

# files that were not finished
PARTIAL = ".*.partial.*"


def check_writable(path: str | os.PathLike[str]) -> None:
    """Finds out before the work starts whether `path` could be written.

    Raises:
        OutputError: Its folder is missing or not writable, or it is there and no regular file.
    """
    path = Path(path)
    # what is asked about is what a link leads to, by the name that was given where there is none
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    try:
        if target.is_dir():
            raise OutputError(path, "it is a folder")
        if target.exists() and not target.is_file():
            raise OutputError(path, "it exists and is not a regular file")
        if not target.parent.is_dir():
            raise OutputError(path, f"folder '{target.parent}' does not exist")
        handle, name = _temporary(target)
        os.close(handle)
        Path(name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(path, str(error.strerror)) from error


def check_outputs(
    outputs: Mapping[str, str | os.PathLike[str] | None], inputs: Iterable[str | os.PathLike[str] | None] = ()
) -> None:
    """Finds out before the work starts whether files could be written, none over another or over one that is read.

    Args:
        outputs: Files to write, by the name of what asks for them; None for one that is not asked for.
        inputs: Files that are read.

    Raises:
        ParameterError: A file is one of the inputs, or that of another name.
        OutputError: It cannot be written.
    """
    read = {os.path.realpath(path) for path in inputs if path is not None and os.path.isfile(path)}
    written: dict[str, str] = {}
    for name, path in outputs.items():
        if path is None:
            continue
        place = os.path.realpath(path)
        if place in read:
            raise ParameterError(name, path, "another file than those that are read")
        if place in written:
            raise ParameterError(name, path, f"another file than that of {written[place]}")
        written[place] = name
        check_writable(path)


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path in the same folder; renames it to `path` if the block succeeds, else removes it.

    Raises:
        OutputError: The file cannot be written.
    """
    path = Path(os.path.realpath(path))  # a link stays one: what it points to is replaced
    check_writable(path)
    try:
        handle, name = _temporary(path)
    except OSError as error:
        raise OutputError(path, str(error.strerror or error)) from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())  # mkstemp makes it private
        os.replace(temporary, path)
    except OutputError as error:
        # whoever writes to the temporary name does not know the file's
        if error.path == temporary:
            raise OutputError(path, error.reason) from error
        raise
    except OSError as error:
        raise OutputError(path, str(error.strerror or error)) from error
    finally:
        temporary.unlink(missing_ok=True)


def lock_folder(folder: Path, who: str) -> int | None:
    """A handle that keeps others out of a folder until it is closed, be it by the end of the process.

    Args:
        folder: The folder.
        who: What the others are called, in the singular.

    Returns:
        The handle; None where there are no locks.

    Raises:
        OutputError: Another one has it.
    """
    if fcntl is None:
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            return None  # not every file system knows locks
        raise OutputError(
            folder, f"another {who} is using it; valid: another folder, or to wait for its end"
        ) from error
    return handle


def remove_partial(folder: Path) -> None:
    """Removes what was left half written in a folder, by something that was killed."""
    for path in folder.glob(PARTIAL):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _temporary(path: Path) -> tuple[int, str]:
    """Handle and name of a new file beside another one."""
    return tempfile.mkstemp(prefix=f".{path.name}.", suffix=f".partial{path.suffix}", dir=path.parent)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
