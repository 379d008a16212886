"""Writers of files that appear complete or not at all: if the process is killed, the old content stays."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.types import AnyArray, InputError

# The names of files that are not complete yet begin with this.
PARTIAL = ".partial-"


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Provide a temporary path beside a file; it replaces the file if the block succeeds and is removed otherwise."""
    path = Path(path)
    # The suffix stays, since writers choose the format by it.
    temporary = path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_arrays(path: str | Path, arrays: Mapping[str, AnyArray], *, compressed: bool = False) -> None:
    """Write arrays to an .npz file in one step."""
    save = np.savez_compressed if compressed else np.savez
    with replacing(path) as temporary, temporary.open("wb") as file:
        save(file, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})


def load_arrays(path: str | Path, advice: str) -> dict[str, np.ndarray]:
    """Read an .npz file; raise InputError with this advice if it is damaged or of another format."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)
    except (zipfile.BadZipFile, zlib.error, EOFError, TypeError, ValueError) as error:
        # TypeError: NumPy also opens a single array (.npy) under this name, which cannot become a dict.
        raise InputError(f"{path} is damaged or no .npz file ({error}); {advice}") from error


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON in one step; NumPy values become plain values, and numbers that are not finite become null."""
    write_text(path, json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: str | Path) -> Any:
    """Read a JSON file; raise InputError if it is damaged."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is not valid JSON: {error}") from error


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text in one step."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, Path):
        return str(value)
    return _plain(np.asarray(value).tolist())
