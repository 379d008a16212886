"""What stands in the folder of a run: status.json, with the stage it has come to and the SHA-256 of its files.

A file belongs to a run if it is in the list, and is read only with a content that the list knows. To replace files, the
new contents are written beside them and announced, each along with the one that stands there; then every file is
replaced in one step. Whoever dies in between leaves a folder in which each file has one of its two contents, whole.
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

# Inputs stand, and a run can be resumed; results stand.
Stage = Literal["prepared", "finished"]


class Status(NamedTuple):
    """The content of status.json.

    Attributes
    ----------
    stage : {"prepared", "finished"} or None
        None until all inputs stand.
    files : mapping
        Path relative to the folder, with slashes, to the SHA-256 that its content has; to two while it is replaced.
    """

    stage: Stage | None = None
    files: Mapping[str, tuple[str, ...]] = {}


def read_status(folder: str | Path) -> Status | None:
    """The status of a folder; None where there is none, InputError where it is damaged."""
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
    """The path of a file of a run; InputError where a link leads out of its folder, which may be a stranger's."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{path} leads out of its folder by a link; put the file itself there")
    return path


def stage_of(folder: str | Path) -> Stage | None:
    """How far the run in a folder has come; None where there is none, or none whose inputs stand."""
    status = read_status(folder)
    return None if status is None else status.stage


def holds_run(folder: str | Path) -> bool:
    """Whether there is a run in a folder; another program's status.json is none."""
    try:
        return read_status(folder) is not None
    except InputError:
        return False


def is_listed(folder: str | Path, name: str) -> bool:
    """Whether a file belongs to the run in a folder."""
    status = read_status(folder)
    return status is not None and name in status.files


def require_file(folder: str | Path, name: str) -> Path:
    """The path of a file of a run.

    Raises
    ------
    InputError
        If there is none of that name, or its content is not the one that the run has written.
    """
    folder = Path(folder)
    status = read_status(folder)
    if status is None:
        raise InputError(f"{folder} holds no run of bayesreg: {STATUS} is missing")
    path = _path_of(folder, name)
    found = digest_of(path) if name in status.files else None
    if found is None:
        state = "no finished run" if status.stage != "finished" else "no whole run"
        raise InputError(f"{folder} holds {state}: {name} is missing")
    if found not in status.files[name]:
        raise InputError(f"{path} is damaged, or was changed after the run had written it; {ANEW}")
    return path


def is_sound(folder: str | Path, name: str) -> bool:
    """Whether a file of a run has the content that the run has written."""
    status = read_status(folder)
    return status is not None and digest_of(Path(folder) / name) in status.files.get(name, ())


def require_unchanged(folder: str | Path, but: str) -> None:
    """Raise InputError where a file of a run, but for one of a name, has not the content that the run has written.

    Files that are read by other programs alone may be gone.
    """
    folder = Path(folder)
    status = read_status(folder) or Status()
    for name in status.files:
        if name != but and (folder / name).is_file():
            require_file(folder, name)


@contextmanager
def writing(folder: str | Path, stage: Stage | None = None) -> Iterator[Callable[[str], Path]]:
    """Write files of a run, all of which appear when the block ends well, and none if it does not.

    Parameters
    ----------
    folder : path
        It is made if need be.
    stage : {"prepared", "finished"}, optional
        Which the run has come to when all of them stand; the same as before where none is given.

    Yields
    ------
    callable
        From the path of a file, relative to the folder, to where its content is to be written.
    """
    folder, temporaries = Path(folder), dict[str, Path]()

    def place(name: str) -> Path:
        target = _path_of(folder, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        # The name's end stays, since writers choose the format by it.
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
    # Of a run whose inputs never stood nothing is kept.
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
    """Tell which of the contents that were announced stands there."""
    if len(digests) == 1:
        return digests
    found = digest_of(folder / name)
    return tuple(digest for digest in digests if digest == found) or digests[:1]


def drop(folder: str | Path, within: str) -> None:
    """Take all files of a subfolder from the list, and then from the disk."""
    folder = Path(folder)
    status = read_status(folder)
    if status is not None:
        names = [name for name in status.files if name.startswith(f"{within}/")]
        _write(folder, Status(status.stage, {name: it for name, it in status.files.items() if name not in names}))
        for name in names:
            _path_of(folder, name).unlink(missing_ok=True)


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Keep other processes out of a folder, which is made if need be, and clear what a killed one left half-written.

    The lock is the operating system's, and ends with the process that holds it, however that ends.

    Raises
    ------
    InputError
        If another process holds it, or nothing can be written there.
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
    """What was being written to a folder, but not to those of other runs within it, which may be written to now."""
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not (Path(place, name, LOCK).exists())]
        found += [Path(place, name) for name in files if name.startswith(PARTIAL)]
    return found


def digest_of(path: Path) -> str | None:
    """SHA-256 of the content of a file; None where there is none."""
    try:
        known = path.stat()
        return _digest_of_file(path, known.st_ino, known.st_size, known.st_mtime_ns)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None


@lru_cache(maxsize=10_000)
def _digest_of_file(path: Path, _inode: int, _size: int, _changed: int) -> str:
    """Taken again where the file system says that the file has changed."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_digest(path: Path) -> str:
    found = digest_of(path)
    assert found is not None
    return found


def _write(folder: Path, status: Status) -> None:
    content: dict[str, Any] = {"stage": status.stage, "files": status.files, "digest": _digest_of(status)}
    write_text(folder / STATUS, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _digest_of(status: Status) -> str:
    plain = json.dumps([status.stage, status.files], sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()
