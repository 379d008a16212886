"""Readers of VTK's legacy format, PLY and OBJ in NumPy; VTK's own readers end the process if a file has a wrong size.

The readers return PyVista datasets. The functions import PyVista themselves, since its import takes seconds and other
code does not need it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any, Literal, cast
from urllib.parse import unquote

import numpy as np
from jaxtyping import Int, Shaped

_HEAD = re.compile(
    rb"# vtk DataFile Version (\d+)\.\d+[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s+DATASET\s+(POLYDATA|UNSTRUCTURED_GRID)\b",
    re.IGNORECASE,
)
_LEGACY_TYPES = {
    "unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
    "unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4", "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
}  # fmt: skip
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
# Number of components of an attribute; other attributes state it in the file.
_COMPONENTS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "SCALARS": 1}
_CELLS = {"VERTICES": "verts", "LINES": "lines", "POLYGONS": "faces", "TRIANGLE_STRIPS": "strips", "CELLS": "cells"}


class _Cursor:
    """An offset in the content of a file, which every read advances; ValueError if the content ends too early."""

    def __init__(self, content: bytes, position: int, is_text: bool, order: Literal["<", ">"]) -> None:
        self.content, self.position, self.is_text, self.order = content, position, is_text, order

    def line(self) -> list[str]:
        """Read the words of the next line that is not empty; return an empty list at the end."""
        while self.position < len(self.content):
            end = self.content.find(b"\n", self.position)
            end = len(self.content) if end < 0 else end
            words, self.position = self.content[self.position : end].decode("utf-8").split(), end + 1
            if words:
                return words
        return []

    def values(self, kind: str, count: int) -> np.ndarray:
        if count < 0:
            raise ValueError("a negative number of values")
        if self.is_text:
            words = list(islice(re.compile(rb"\S+").finditer(self.content, self.position), count))
            if len(words) < count:
                raise ValueError("it is cut short")
            self.position = words[-1].end() if words else self.position
            return np.array([word[0] for word in words], "S").astype(float if kind[0] == "f" else int).astype(kind)
        stored = np.dtype(kind).newbyteorder(self.order)
        start, self.position = self.position, self.position + count * stored.itemsize
        if self.position > len(self.content):
            raise ValueError("it is cut short")
        return np.frombuffer(self.content, stored, count, start).astype(kind)

    def texts(self, count: int) -> list[str]:
        """Read texts.

        A text file has one text per line. In a binary file the length precedes each text; the first two bits of the
        length give the number of bytes of the length itself.
        """
        if self.is_text:
            return [unquote(" ".join(self.line())) for _ in range(count)]
        texts = []
        for _ in range(count):
            size = 2 ** (3 - (int(self.values("u1", 1)[0]) >> 6))
            self.position -= 1
            length = int(self.values(f"u{size}", 1)[0]) & (2 ** (8 * size - 2) - 1)
            texts.append(self.values("u1", length).tobytes().decode("utf-8"))
        return texts

    def cells(self, first: int, second: int, has_offsets: bool) -> Int[np.ndarray, "n"]:
        """Read cells as one array in which the number of points of each cell precedes their indices."""
        if not has_offsets:
            return self.values("i4", second)
        offsets = self.values(_legacy_type(self.line()[1]), first).astype(np.int64)
        return join_cells(offsets, self.values(_legacy_type(self.line()[1]), second).astype(np.int64))

    def skip(self, pattern: bytes) -> None:
        if (match := re.compile(pattern, re.DOTALL).match(self.content, self.position)) is not None:
            self.position = match.end()


def join_cells(offsets: Int[np.ndarray, "c"], points: Int[np.ndarray, "k"]) -> Int[np.ndarray, "n"]:
    """Join cells to one array in which the number of points of each cell precedes their indices.

    `offsets` are the indices into `points` at which the cells begin, and the end of the last cell.
    """
    if not len(offsets):
        return np.zeros(0, np.int64)
    counts = np.diff(offsets)
    if offsets[0] != 0 or offsets[-1] != len(points) or (counts < 0).any():
        raise ValueError("the offsets of its cells do not fit")
    return np.insert(points, offsets[:-1], counts)


def split_cells(cells: Shaped[np.ndarray, "n"], count: int) -> list[np.ndarray]:
    """Split joined cells into the point indices of each cell.

    Raise ValueError if a cell has an index of `count` or more, or does not end within the array.
    """
    indices, start = [], 0
    while start < len(cells):
        end = start + 1 + int(cells[start])
        if not start < end <= len(cells):
            raise ValueError("a cell does not end where it says")
        indices.append(cells[start + 1 : end])
        start = end
    points = np.concatenate([np.zeros(0, np.int64), *indices])
    if len(points) and not 0 <= points.min() <= points.max() < count:
        raise ValueError(f"a cell has the point {points.max()} of {count} points")
    return indices


def read_legacy(content: bytes) -> Any:
    """Read a surface or grid in VTK's legacy format; raise ValueError, KeyError or IndexError if it is damaged."""
    head = _HEAD.match(content)
    if head is None:
        raise ValueError("it does not begin as a surface or grid of VTK's legacy format")
    cursor = _Cursor(content, head.end(), head[2].upper() == b"ASCII", ">")
    geometry: dict[str, np.ndarray] = {}
    arrays: dict[str, dict[str, Any]] = {"": {}, "POINT_DATA": {}, "CELL_DATA": {}}
    section, rows = "", 0
    while words := cursor.line():
        key = words[0].upper()
        if key == "POINTS":
            geometry["points"] = cursor.values(_legacy_type(words[2]), 3 * int(words[1])).reshape(-1, 3)
        elif key in _CELLS:
            geometry[_CELLS[key]] = cursor.cells(int(words[1]), int(words[2]), int(head[1]) >= 5)
        elif key == "CELL_TYPES":
            geometry["types"] = cursor.values("i4", int(words[1]))
        elif key in arrays:
            section, rows = key, int(words[1])
        elif key == "FIELD":
            for _ in range(int(words[2])):
                name, width, length, kind = cursor.line()
                size = int(width) * int(length)
                arrays[section][unquote(name)] = (
                    cursor.texts(size)
                    if kind == "string"
                    else _rows(cursor.values(_legacy_type(kind), size), int(width))
                )
        elif key in _COMPONENTS:
            components = int(words[3]) if key == "SCALARS" and len(words) > 3 else _COMPONENTS[key]
            cursor.skip(rb"\s*LOOKUP_TABLE\s+\S+[ \r]*\n" if key == "SCALARS" else b"")
            values = cursor.values(_legacy_type(words[2]), components * rows)
            arrays[section][unquote(words[1])] = _rows(values, components)
        elif key == "TEXTURE_COORDINATES":
            values = cursor.values(_legacy_type(words[3]), int(words[2]) * rows)
            arrays[section][unquote(words[1])] = _rows(values, int(words[2]))
        elif key == "COLOR_SCALARS":
            values = cursor.values("f4" if cursor.is_text else "u1", int(words[2]) * rows)
            # In text files colours are in [0, 1].
            values = np.rint(255 * values).astype(np.uint8) if cursor.is_text else values
            arrays[section][unquote(words[1])] = _rows(values, int(words[2]))
        elif key == "LOOKUP_TABLE":
            cursor.values("f4" if cursor.is_text else "u1", 4 * int(words[2]))
        elif key == "METADATA":
            cursor.skip(rb".*?(\n\s*\n|\Z)")
        else:
            raise ValueError(f"it has {key[:20]!r} where a word of VTK's is expected")
    return _dataset(geometry, arrays)


def read_ply(content: bytes) -> Any:
    """Read the points and faces of a PLY file; raise the errors of `read_legacy`."""
    head = re.match(rb"ply\s(.*?)end_header[ \r]*\n", content, re.DOTALL)
    if head is None:
        raise ValueError("it does not begin as PLY")
    lines = [line.split() for line in head[1].decode("utf-8").splitlines()]
    elements: list[tuple[str, int, list[list[str]]]] = []
    form = "none"
    for words in lines:
        if words and words[0] == "format":
            form = words[1]
        elif words and words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words and words[0] == "property":
            elements[-1][2].append(words[1:])
    orders: dict[str, Literal["<", ">"]] = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
    geometry: dict[str, np.ndarray] = {}
    cursor = _Cursor(content, head.end(), form == "ascii", orders[form])
    for name, count, properties in elements:
        if count > len(content):
            raise ValueError("it is cut short")
        rows = [[_ply_value(cursor, words) for words in properties] for _ in range(count)]
        names = [words[-1] for words in properties]
        if name == "vertex":
            columns = [names.index(axis) for axis in "xyz"]
            geometry["points"] = np.array([[row[k] for k in columns] for row in rows], float).reshape(-1, 3)
        elif name == "face":
            column = names.index("vertex_index" if "vertex_index" in names else "vertex_indices")
            geometry["faces"] = _join([row[column] for row in rows])
    return _dataset(geometry)


def _ply_value(cursor: _Cursor, words: Sequence[str]) -> Any:
    if words[0] == "list":
        return cursor.values(_PLY_TYPES[words[2]], int(cursor.values(_PLY_TYPES[words[1]], 1)[0]))
    return cursor.values(_PLY_TYPES[words[0]], 1)[0]


def read_obj(content: bytes) -> Any:
    """Read the points, faces and lines of a Wavefront OBJ file; raise the errors of `read_legacy`."""
    points: list[list[str]] = []
    cells: dict[str, list[list[int]]] = {"f": [], "l": []}
    for line in content.decode("utf-8", "replace").splitlines():
        key, *words = line.split() or [""]
        if key == "v":
            points.append(words[:3])
        elif key in cells:
            # Positive numbers count from 1, negative ones back from the last point.
            numbers = [int(word.split("/")[0]) for word in words]
            cells[key].append([number - 1 if number > 0 else len(points) + number for number in numbers])
    return _dataset({
        "points": np.array(points, float).reshape(-1, 3), "faces": _join(cells["f"]), "lines": _join(cells["l"]),
    })  # fmt: skip


def _legacy_type(name: str) -> str:
    return _LEGACY_TYPES[name.lower()]


def _rows(values: np.ndarray, components: int) -> np.ndarray:
    return values if components == 1 else values.reshape(-1, components)


def _join(cells: Iterable[Any]) -> Int[np.ndarray, "n"]:
    return np.concatenate([np.zeros(0, np.int64), *(np.array([len(cell), *cell], np.int64) for cell in cells)])


def _dataset(geometry: dict[str, np.ndarray], arrays: dict[str, dict[str, Any]] | None = None) -> Any:
    """Create a PyVista dataset after a check that its cells only use existing points."""
    import pyvista

    points, types = geometry.pop("points", np.zeros((0, 3))), geometry.pop("types", None)
    split = {name: split_cells(cells, len(points)) for name, cells in geometry.items()}
    if types is not None or "cells" in geometry:
        if set(geometry) != {"cells"} or types is None or len(types) != len(split["cells"]):
            raise ValueError("the types of its cells do not fit")
        dataset = pyvista.UnstructuredGrid(geometry["cells"], types.astype(np.uint8), points)
    else:
        dataset = pyvista.PolyData(points, **cast(Any, geometry))
    for name, target in (("POINT_DATA", "point_data"), ("CELL_DATA", "cell_data"), ("", "field_data")):
        for key, values in (arrays or {}).get(name, {}).items():
            getattr(dataset, target)[key] = values
    return dataset
