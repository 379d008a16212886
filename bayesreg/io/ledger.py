"""The record of a run's folder, status.json: the stage of the run and the SHA-256 digests of its files.

A file belongs to a run if status.json lists it. It is read only if its content has a listed digest. To replace files,
the new contents are first written beside the old ones. Then status.json lists the old and the new digest of each file.
Then every file is replaced in one step. If the process dies in between, each file has one of its two contents,
complete.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, Literal, NamedTuple

from filelock import FileLock, Timeout

from bayesreg.io.atomic import PARTIAL, write_text
from bayesreg.types import InputError

STATUS, LOCK = "status.json", ".lock"
ANEW = "run anew, into another folder"

# "prepared": all inputs are written, and the run can be resumed. "finished": all results are written.
Stage = Literal["prepared", "finished"]


class Status(NamedTuple):
    """The content of status.json.

    Attributes
    ----------
    stage : {"prepared", "finished"} or None
        None until all inputs are written.
    files : mapping
        From the path of a file, relative to the folder and with slashes, to the SHA-256 of its content; to two digests
        while the file is replaced.
    """

    stage: Stage | None = None
    files: Mapping[str, tuple[str, ...]] = {}


def read_status(folder: str | Path) -> Status | None:
    """Read the status of a folder; return None if it has none, and raise InputError if it is damaged."""
    path = Path(folder) / STATUS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        status = Status(content["stage"], {name: tuple(digests) for name, digests in content["files"].items()})
        sound = content["digest"] == _digest_of(status) and not any(map(_leads_out, status.files))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        if error.errno == errno.ELOOP:
            return None
        if not isinstance(error, IsADirectoryError):
            raise
        sound = False
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        sound = False
    if not sound:
        raise InputError(f"{path} is damaged, and nothing in its folder can be relied on without it; {ANEW}")
    return status


def _leads_out(name: str) -> bool:
    return PurePath(name).is_absolute() or ".." in PurePath(name).parts


def _path_of(folder: Path, name: str) -> Path:
    """Build the path of a file of a run; raise InputError if a link leads out of the folder.

    The folder may come from another person, whose links must not reach other files.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{path} leads out of its folder by a link; put the file itself there")
    return path


def stage_of(folder: str | Path) -> Stage | None:
    """Read the stage of the run in a folder; return None if there is no run or its inputs are incomplete."""
    status = read_status(folder)
    return None if status is None else status.stage


def holds_run(folder: str | Path) -> bool:
    """Check whether a folder holds a run; a status.json of another program does not count."""
    try:
        return read_status(folder) is not None
    except InputError:
        return False


def is_listed(folder: str | Path, name: str) -> bool:
    """Check whether a file belongs to the run in a folder."""
    status = read_status(folder)
    return status is not None and name in status.files


def require_file(folder: str | Path, name: str) -> Path:
    """Return the path of a file of a run after a check of its content.

    Raises
    ------
    InputError
        If the run has no file of that name, or its content is not what the run wrote.
    """
    folder = Path(folder)
    status = read_status(folder)
    if status is None:
        raise InputError(f"{folder} holds no run of bayesreg: {STATUS} is missing")
    path = _path_of(folder, name)
    digest = digest_of(path) if name in status.files else None
    if digest is None:
        state = "no finished run" if status.stage != "finished" else "no whole run"
        raise InputError(f"{folder} holds {state}: {name} is missing")
    if digest not in status.files[name]:
        raise InputError(f"{path} is damaged, or was changed after the run had written it; {ANEW}")
    return path


def is_sound(folder: str | Path, name: str) -> bool:
    """Check whether a file of a run has the content that the run wrote."""
    status = read_status(folder)
    return status is not None and digest_of(Path(folder) / name) in status.files.get(name, ())


def require_unchanged(folder: str | Path, but: str) -> None:
    """Raise InputError if a file of a run, except the file `but`, has other content than the run wrote.

    Missing files are allowed, since some are only for other programs.
    """
    folder = Path(folder)
    status = read_status(folder) or Status()
    for name in status.files:
        if name != but and (folder / name).is_file():
            require_file(folder, name)


@contextmanager
def writing(folder: str | Path, stage: Stage | None = None) -> Iterator[Callable[[str], Path]]:
    """Write files of a run; all of them appear if the block succeeds, and none otherwise.

    Parameters
    ----------
    folder : path
        The folder of the run; it is created if necessary.
    stage : {"prepared", "finished"}, optional
        The stage of the run after all files are written; by default the stage does not change.

    Yields
    ------
    callable
        From the path of a file, relative to the folder, to the temporary path where its content is to be written.
    """
    folder, temporaries = Path(folder), dict[str, Path]()

    def place(name: str) -> Path:
        target = _path_of(folder, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        # The suffix stays, since writers choose the format by it.
        temporaries[name] = target.with_name(f"{PARTIAL}{os.getpid()}-{target.name}")
        return temporaries[name]

    try:
        yield place
        _replace(folder, {name: path for name, path in temporaries.items() if path.exists()}, stage)
    finally:
        for path in temporaries.values():
            path.unlink(missing_ok=True)


def _replace(folder: Path, temporaries: Mapping[str, Path], stage: Stage | None) -> None:
    before = read_status(folder) or Status()
    # If the inputs of an earlier run were never complete, none of its files is kept.
    listed = {} if before.stage is None and stage is not None else before.files
    standing = {name: _standing(folder, name, digests) for name, digests in listed.items()}
    new = {name: (_require_digest(path),) for name, path in temporaries.items()}
    announced = standing | {name: tuple(dict.fromkeys((*standing.get(name, ()), *new[name]))) for name in new}
    _write(folder, Status(before.stage, announced))
    for name, path in temporaries.items():
        path.replace(folder / name)
    if stage is not None:
        _write(folder, Status(stage, standing | new))


def _standing(folder: Path, name: str, digests: tuple[str, ...]) -> tuple[str, ...]:
    """Find which of the listed digests the file has; the first one if it has none of them."""
    if len(digests) == 1:
        return digests
    current = digest_of(folder / name)
    return tuple(digest for digest in digests if digest == current) or digests[:1]


def drop(folder: str | Path, within: str) -> None:
    """Remove all files of a subfolder from the list, and then from the disk."""
    folder = Path(folder)
    status = read_status(folder)
    if status is not None:
        names = [name for name in status.files if name.startswith(f"{within}/")]
        _write(
            folder, Status(status.stage, {name: digests for name, digests in status.files.items() if name not in names})
        )
        for name in names:
            _path_of(folder, name).unlink(missing_ok=True)


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Lock a folder against other processes, and remove the partial files of a killed process.

    The folder is created if necessary. The lock belongs to the operating system and ends with the process that holds
    it, even if that process is killed.

    Raises
    ------
    InputError
        If another process holds the lock, or the folder is not writable.
    """
    folder = Path(folder)
    lock = FileLock(folder / LOCK, timeout=0, is_singleton=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        raise InputError(f"another process is working in {folder}; wait until it has ended") from error
    except (PermissionError, FileExistsError, NotADirectoryError) as error:
        raise InputError(
            f"nothing can be written into {folder} ({error.strerror}), where a run keeps its files"
        ) from error
    try:
        for path in _half_written(folder):
            path.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def _half_written(folder: Path) -> list[Path]:
    """List the partial files in a folder.

    Folders of other runs within it are excluded, since another process may be writing to them.
    """
    paths = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not (Path(parent, name, LOCK).exists())]
        paths += [Path(parent, name) for name in files if name.startswith(PARTIAL)]
    return paths


def digest_of(path: Path) -> str | None:
    """Compute the SHA-256 of the content of a file; return None if there is no such file."""
    try:
        known = path.stat()
        return _digest_of_file(path, known.st_ino, known.st_size, known.st_mtime_ns)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None


@lru_cache(maxsize=10_000)
def _digest_of_file(path: Path, _inode: int, _size: int, _changed: int) -> str:
    """Compute the SHA-256 of a file again only if its inode, size or modification time has changed."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_digest(path: Path) -> str:
    digest = digest_of(path)
    assert digest is not None
    return digest


def _write(folder: Path, status: Status) -> None:
    content: dict[str, Any] = {"stage": status.stage, "files": status.files, "digest": _digest_of(status)}
    write_text(folder / STATUS, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _digest_of(status: Status) -> str:
    plain = json.dumps([status.stage, status.files], sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()
