"""Check that the files of a configuration are unchanged or missing when a run is resumed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bayesreg.config import Config
from bayesreg.io.run_folder import digest_of
from bayesreg.types import InputError


def digests_of_sources(config: Config, but: tuple[str, ...]) -> dict[str, str]:
    """Compute the SHA-256 of every file or folder that the configuration names, by key, without the sections `but`."""
    named = _paths(config.model_dump(exclude=set(but)))
    return {key: digest for key, path in named if (digest := _digest_of(path)) is not None}


def require_same_sources(config: Config, digests: Mapping[str, str], but: tuple[str, ...], folder: Path) -> None:
    """Raise InputError if the content of a file changed since the run in a folder was begun.

    A missing file is no error: the folder holds the inputs that were made from it.
    """
    now = digests_of_sources(config, but)
    if changed := [key for key, digest in digests.items() if now.get(key, digest) != digest]:
        named = dict(_paths(config.model_dump()))
        listed = ", ".join(f"{key} ({named[key]})" for key in changed)
        raise InputError(
            f"{listed} has changed since the run in {folder} was begun, which goes on with what it was: name another "
            "folder for a run of the new content, or put the former one back"
        )


def _digest_of(path: Path) -> str | None:
    """Compute the digest of a file, or of all files in a folder, such as a DICOM series; None if neither exists."""
    if not path.is_dir():
        return digest_of(path)
    content = [f"{file.relative_to(path)}\0{digest_of(file)}" for file in sorted(path.rglob("*")) if file.is_file()]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()


def _paths(value: Any, key: str = "") -> Iterator[tuple[str, Path]]:
    if isinstance(value, Path):
        yield key, value
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list | tuple) else ()
    for name, entry in items:
        yield from _paths(entry, f"{key}.{name}".removeprefix("."))
