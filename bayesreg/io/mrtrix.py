"""MRtrix's images (.mif, .mif.gz, .mih), which neither nibabel nor SimpleITK reads.

A header of text lines `key: value`, up to END where voxels follow; then, from the offset that `file: . offset` gives,
or in the file that `file: name` does, the voxels. `layout` says of each axis how many others run faster, and by its
sign whether it runs backwards; `transform` and `vox` are those of the axes by name, in world RAS and mm.
(https://mrtrix.readthedocs.io/en/latest/getting_started/image_data.html)
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections import defaultdict
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayesreg.types import InputError

SUFFIXES = (".mif", ".mif.gz", ".mih")
FIRST_LINE = b"mrtrix image"
# A header that is longer is none.
LONGEST_HEADER = 1_000_000
_TYPES = {"int": "i", "uint": "u", "float": "f"}


def is_mrtrix(path: Path) -> bool:
    """Tell whether a file is MRtrix's, by its name."""
    return path.name.lower().endswith(SUFFIXES)


def read_mrtrix(path: Path) -> tuple[np.ndarray, Float[np.ndarray, "4 4"]]:
    """Voxels, scaled as the header says, and the affine from their indices to world RAS, mm.

    Raises
    ------
    InputError
        If the file cannot be read, is none of MRtrix's, or is cut short.
    """
    content = _content(path)
    try:
        header, length = _header(content)
        shape = tuple(int(count) for count in header["dim"][0].split(","))
        stored = b"".join(_stored(path, content, length, place) for place in header["file"])
        voxels = _voxels(stored, shape, header["layout"][0], header["datatype"][0])
        if "scaling" in header:
            shift, factor = (float(number) for number in header["scaling"][0].split(","))
            voxels = shift + factor * voxels if (shift, factor) != (0, 1) else voxels
        return voxels, _affine(header)
    except (KeyError, IndexError) as error:
        raise InputError(f"image {path} cannot be read: its header lacks {error}") from error
    except ValueError as error:
        raise InputError(f"image {path} cannot be read, its header or content is damaged: {error}") from error


def _stored(path: Path, content: bytes, length: int, place: str) -> bytes:
    """The voxels that a line `file:` names: here or in another file, from an offset on."""
    known = re.fullmatch(r"(.*?)(?:\s+(\d+))?", place)
    assert known is not None
    name, first = known[1], int(known[2] or 0)
    if name == ".":
        if first < length:
            raise ValueError(f"its voxels begin at {first}, within the header")
        return content[first:]
    return _content(path.parent / name)[first:]


def _content(path: Path) -> bytes:
    try:
        return gzip.decompress(path.read_bytes()) if path.name.lower().endswith(".gz") else path.read_bytes()
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"image {path} cannot be read: {error}") from error


def _header(content: bytes) -> tuple[dict[str, list[str]], int]:
    """The values of every key, in their order, and the length of the header."""
    if not content.startswith(FIRST_LINE):
        raise ValueError("it does not begin as MRtrix's images do")
    last = re.compile(rb"\nEND[ \t\r]*(?=\n|\Z)").search(content, 0, LONGEST_HEADER)
    end = last.start() if last else -1
    if end < 0 and len(content) < LONGEST_HEADER:
        # A header whose voxels lie in another file ends with its own.
        end = len(content)
    if end < 0:
        raise ValueError("its header has no end")
    found = defaultdict(list)
    for line in content[:end].decode("utf-8", errors="replace").splitlines()[1:]:
        key, _, value = line.partition(":")
        found[key.strip().lower()].append(value.strip())
    return dict(found), last.end() if last else end


def _voxels(content: bytes, shape: tuple[int, ...], layout: str, datatype: str) -> np.ndarray:
    known = re.fullmatch(r"(int|uint|float)(8|16|32|64)(le|be)?", datatype.lower())
    if known is None and datatype.lower() != "bit":
        raise ValueError(f"its voxels are {datatype}; expected whole or real numbers")
    signs = re.findall(r"([+-]?)(\d+)", layout)
    ranks = [int(rank) for _, rank in signs]
    if min(shape, default=0) < 1 or sorted(ranks) != list(range(len(shape))):
        raise ValueError(f"its header gives the shape {shape} and the layout {layout}")
    count = int(np.prod(shape, dtype=object))
    flat: np.ndarray
    if known is None:
        flat = np.unpackbits(np.frombuffer(content[: -(-count // 8)], np.uint8))[:count]
    else:
        kind, bits, order = known.groups()
        numbers = np.dtype(f"{'>' if order == 'be' else '<'}{_TYPES[kind]}{int(bits) // 8}")
        flat = np.frombuffer(content[: count * numbers.itemsize], numbers) if content else np.zeros(0)
        flat = flat.astype(numbers.newbyteorder("="))
    if len(flat) < count:
        raise ValueError(f"it is cut short: {len(flat)} of {count} voxels are there")
    by_speed = np.argsort(ranks)
    stored = flat.reshape([shape[axis] for axis in by_speed], order="F")
    voxels = stored.transpose(np.argsort(by_speed))
    return voxels[tuple(slice(None, None, -1 if sign == "-" else 1) for sign, _ in signs)]


def _affine(header: dict[str, list[str]]) -> Float[np.ndarray, "4 4"]:
    sizes = [float(size) for size in header["vox"][0].split(",")][:3]
    rows = [[float(number) for number in row.split(",")] for row in header["transform"][:3]]
    affine = np.eye(4)
    affine[:3] = np.array(rows)
    affine[:3, :3] *= sizes
    return affine
