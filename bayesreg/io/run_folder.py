"""The folder of a run, and its record status.json: the stage of the run and the SHA-256 digests of its files.

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
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any, Literal, NamedTuple

from filelock import FileLock, Timeout

from bayesreg.io.atomic import PARTIAL, write_text
from bayesreg.types import InputError

STATUS, LOCK = "status.json", ".lock"
ANEW = "run anew, into another folder"
RESULTS = (
    STATUS, "config.yaml", "run.json", "mesh.vtu", "posterior.nc", "draws", "state.npz", "inputs", "report.html",
)  # fmt: skip

# "prepared": all inputs are written, and the run can be resumed. "finished": all results are written.
Stage = Literal["prepared", "finished"]
# A function from the path of a file, relative to the run's folder, to the temporary path where it is to be written.
Place = Callable[[str], Path]


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


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run; it may be missing.

    Attributes
    ----------
    path : Path
    """

    path: Path

    def status(self) -> Status | None:
        """Read the status; return None if the folder has none, and raise InputError if it is damaged."""
        path = self.path / STATUS
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

    @property
    def stage(self) -> Stage | None:
        """The stage of the run; None if there is no run or its inputs are incomplete."""
        status = self.status()
        return None if status is None else status.stage

    @property
    def holds_run(self) -> bool:
        """Whether the folder holds a run; a status.json of another program does not count."""
        try:
            return self.status() is not None
        except InputError:
            return False

    def is_listed(self, name: str) -> bool:
        """Check whether a file belongs to the run."""
        status = self.status()
        return status is not None and name in status.files

    def is_sound(self, name: str) -> bool:
        """Check whether a file of the run has the content that the run wrote."""
        status = self.status()
        return status is not None and digest_of(self.path / name) in status.files.get(name, ())

    def file(self, name: str) -> Path:
        """Return the path of a file of the run after a check of its content.

        Raises
        ------
        InputError
            If the run has no file of that name, or its content is not what the run wrote.
        """
        status = self.status()
        if status is None:
            raise InputError(f"{self.path} holds no run of bayesreg: {STATUS} is missing")
        path = self._path_of(name)
        digest = digest_of(path) if name in status.files else None
        if digest is None:
            state = "no finished run" if status.stage != "finished" else "no whole run"
            raise InputError(f"{self.path} holds {state}: {name} is missing")
        if digest not in status.files[name]:
            raise InputError(f"{path} is damaged, or was changed after the run had written it; {ANEW}")
        return path

    def require_unchanged(self, but: str) -> None:
        """Raise InputError if a file of the run, except the file `but`, has other content than the run wrote.

        Missing files are allowed, since some are only for other programs.
        """
        status = self.status() or Status()
        for name in status.files:
            if name != but and (self.path / name).is_file():
                self.file(name)

    def require_fresh(self) -> None:
        """Raise InputError if the path is a file, or holds a run, lies in a run's folder or is not writable."""
        path = self.path
        nearest = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        if path.is_symlink() and not path.exists():
            raise InputError(f"the output folder {path} is a link that leads nowhere")
        if within := [parent for parent in path.absolute().parents if RunFolder(parent).holds_run]:
            raise InputError(f"the output folder {path} lies in that of another run, {within[0]}; name another one")
        if path.exists() and not path.is_dir():
            raise InputError(f"the output folder {path} is a file; name a folder that is new or empty")
        if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
            raise InputError(f"the output folder {path} cannot be written: {nearest} is no folder that you may write")
        held = [name for name in RESULTS if (path / name).exists()]
        if held:
            raise InputError(
                f"the output folder {path} already holds a run ({', '.join(held)}); "
                "name another folder, or continue that run with --resume"
            )

    def require_finished(self) -> None:
        """Raise InputError if the folder holds no finished run."""
        stage = self.stage
        if stage == "prepared":
            raise InputError(f"the run in {self.path} has not ended; bayesreg run --resume goes on with it")
        if stage is None:
            raise InputError(f"{self.path} holds no run of bayesreg: {STATUS} is missing")

    @contextmanager
    def writing(self, stage: Stage | None = None) -> Iterator[Place]:
        """Write files of the run; all of them appear if the block succeeds, and none otherwise.

        The folder is created if necessary.

        Parameters
        ----------
        stage : {"prepared", "finished"}, optional
            The stage of the run after all files are written; by default the stage does not change.

        Yields
        ------
        callable
            From the path of a file, relative to the folder, to the temporary path where its content is to be written.
        """
        temporaries = dict[str, Path]()

        def place(name: str) -> Path:
            target = self._path_of(name)
            target.parent.mkdir(parents=True, exist_ok=True)
            # The suffix stays, since writers choose the format by it.
            temporaries[name] = target.with_name(f"{PARTIAL}{os.getpid()}-{target.name}")
            return temporaries[name]

        try:
            yield place
            self._replace({name: path for name, path in temporaries.items() if path.exists()}, stage)
        finally:
            for path in temporaries.values():
                path.unlink(missing_ok=True)

    def drop(self, within: str) -> None:
        """Remove all files of a subfolder from the list, and then from the disk."""
        status = self.status()
        if status is not None:
            dropped = [name for name in status.files if name.startswith(f"{within}/")]
            remaining = {name: digests for name, digests in status.files.items() if name not in dropped}
            self._write(Status(status.stage, remaining))
            for name in dropped:
                self._path_of(name).unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove the run: all of its files, and then its status."""
        status = self.status()
        if status is not None:
            paths = [self._path_of(name) for name in status.files]
            for path in paths:
                path.unlink(missing_ok=True)
            (self.path / STATUS).unlink()
            for folder in {path.parent for path in paths} - {self.path}:
                with suppress(OSError):  # The folder holds other files, too.
                    folder.rmdir()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other processes, and remove the partial files of a killed process.

        The folder is created if necessary. The lock belongs to the operating system and ends with the process that
        holds it, even if that process is killed.

        Raises
        ------
        InputError
            If another process holds the lock, or the folder is not writable.
        """
        lock = FileLock(self.path / LOCK, timeout=0, is_singleton=True)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout as error:
            raise InputError(f"another process is working in {self.path}; wait until it has ended") from error
        except (PermissionError, FileExistsError, NotADirectoryError) as error:
            raise InputError(
                f"nothing can be written into {self.path} ({error.strerror}), where a run keeps its files"
            ) from error
        try:
            for path in _half_written(self.path):
                path.unlink(missing_ok=True)
            yield
        finally:
            lock.release()

    def _path_of(self, name: str) -> Path:
        """Build the path of a file; raise InputError if a link leads out of the folder.

        The folder may come from another person, whose links must not reach other files.
        """
        path = self.path / name
        if not path.resolve().is_relative_to(self.path.resolve()):
            raise InputError(f"{path} leads out of its folder by a link; put the file itself there")
        return path

    def _replace(self, temporaries: Mapping[str, Path], stage: Stage | None) -> None:
        before = self.status() or Status()
        # If the inputs of an earlier run were never complete, none of its files is kept.
        listed = {} if before.stage is None and stage is not None else before.files
        standing = {name: self._standing(name, digests) for name, digests in listed.items()}
        new = {name: (_require_digest(path),) for name, path in temporaries.items()}
        announced = standing | {name: tuple(dict.fromkeys((*standing.get(name, ()), *new[name]))) for name in new}
        self._write(Status(before.stage, announced))
        for name, path in temporaries.items():
            path.replace(self.path / name)
        if stage is not None:
            self._write(Status(stage, standing | new))

    def _standing(self, name: str, digests: tuple[str, ...]) -> tuple[str, ...]:
        """Find which of the listed digests the file has; the first one if it has none of them."""
        if len(digests) == 1:
            return digests
        current = digest_of(self.path / name)
        return tuple(digest for digest in digests if digest == current) or digests[:1]

    def _write(self, status: Status) -> None:
        content: dict[str, Any] = {"stage": status.stage, "files": status.files, "digest": _digest_of(status)}
        write_text(self.path / STATUS, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _leads_out(name: str) -> bool:
    return PurePath(name).is_absolute() or ".." in PurePath(name).parts


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
        stat = path.stat()
        return _digest_of_file(path, stat.st_ino, stat.st_size, stat.st_mtime_ns)
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


def _digest_of(status: Status) -> str:
    plain = json.dumps([status.stage, status.files], sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()
