"""Formats of points: CSV, 3D Slicer's .fcsv and .mrk.json, MNI's .tag; from text to points in world RAS, mm.

A CSV has a header: `fixed_x, fixed_y, fixed_z, moving_x, moving_y, moving_z` for pairs or `x, y, z` for points, and
optionally `sd` (mm) and `name`; for pairs also `second_x, second_y, second_z`, the moving points as read again. It is
in RAS unless it has a line `# CoordinateSystem = LPS`. The other formats state whether they are in LPS or RAS; MNI's
format is in RAS.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.io.spaces import TO_RAS, Space
from bayesreg.types import InputError

FIXED, MOVING, SECOND = (tuple(f"{side}_{axis}" for axis in "xyz") for side in ("fixed", "moving", "second"))
PLAIN = ("x", "y", "z")
# Factors that convert points from a file's coordinate system to RAS.
SYSTEMS = {**TO_RAS, "0": TO_RAS["RAS"], "1": TO_RAS["LPS"]}

# The rows of a tag file end at the first semicolon outside quotes.
TAG_ROWS = r'Points\s*=((?:"[^"]*"|[^";])*);'


class Points(NamedTuple):
    """Points in one space.

    Attributes
    ----------
    points : (k, 3) array
        World RAS, mm.
    names : tuple of str
        Empty for a point without a name.
    sd : (k,) array or None
        Standard deviation of each coordinate, mm, if the file gives it.
    """

    points: Float[np.ndarray, "k 3"]
    names: tuple[str, ...]
    sd: Float[np.ndarray, "k"] | None = None
    undefined: tuple[int, ...] = ()
    """The numbers of the points without a position, which are zero in `points`: Slicer's points that are not placed."""

    @property
    def defined(self) -> Points:
        """The points that have a position."""
        kept = np.setdiff1d(np.arange(len(self.names)), self.undefined).astype(int)
        names = tuple(self.names[k] for k in kept)
        return Points(self.points[kept], names, None if self.sd is None else self.sd[kept])


class PointPairs(NamedTuple):
    """Pairs of points; the two points of a pair mark the same place of the anatomy.

    Attributes
    ----------
    fixed, moving : (k, 3) arrays
        World RAS, mm.
    names : tuple of str
    sd : (k,) array or None
        Standard deviation of each coordinate, mm, if the file gives it.
    second : (k, 3) array or None
        The moving points as they were read a second time, world RAS, mm.
    """

    fixed: Float[np.ndarray, "k 3"]
    moving: Float[np.ndarray, "k 3"]
    names: tuple[str, ...]
    sd: Float[np.ndarray, "k"] | None = None
    second: Float[np.ndarray, "k 3"] | None = None

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Convert the fields that are not None to named arrays, for files."""
        return {name: np.asarray(value) for name, value in self._asdict().items() if value is not None}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PointPairs:
        """Create pairs from the arrays of `as_arrays`."""
        names = tuple(arrays["names"].tolist())
        return cls(arrays["fixed"], arrays["moving"], names, arrays.get("sd"), arrays.get("second"))


def _read_csv(text: str, path: str, space: Space | None) -> Points | PointPairs:
    lines = [
        (number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip() and line.lstrip()[0] != "#"
    ]
    system = _space_of(text, space, path)
    if not lines:
        pairs, points = (",".join(names) for names in (FIXED + MOVING, PLAIN))
        raise InputError(f"{path} is empty; expected a header: {pairs} for pairs, or {points}")
    header, *rows = [(number, [cell.strip() for cell in next(csv.reader([line]))]) for number, line in lines]
    columns = [column.lower() for column in header[1]]
    wanted = FIXED + MOVING if set(FIXED + MOVING) <= set(columns) else PLAIN
    if wanted != PLAIN and set(SECOND) & set(columns):
        wanted += SECOND
    if wanted == PLAIN and "t" in columns and space is None and not _named_system(text, "", path):
        raise InputError(
            f"{path} has the columns x, y, z, t, as ANTs writes points, whose coordinates are LPS; say whether these "
            "are, by --space or by a line such as # CoordinateSystem = LPS"
        )
    if twice := [column for column in (*wanted, "sd", "name") if columns.count(column) > 1]:
        raise InputError(f"{path}: expected one column {twice[0]}; got {', '.join(header[1])}")
    if not set(wanted) <= set(columns) and ";" in header[1][0]:
        raise InputError(f"{path} separates its columns by semicolons; expected commas, and points in decimal numbers")
    if not set(wanted) <= set(columns):
        raise InputError(
            f"{path}: expected a header with {', '.join(FIXED + MOVING)}, with these and "
            f"{', '.join(SECOND)}, or with {', '.join(PLAIN)}; got {', '.join(header[1])}"
        )
    for number, cells in rows:
        if len(cells) != len(columns):
            raise InputError(f"{path}, line {number}: expected {len(columns)} columns, got {len(cells)}")

    def values(names: Sequence[str]) -> np.ndarray:
        places = [columns.index(name) for name in names]
        return np.array([[_number(cells[k], f"{path}, line {n}") for k in places] for n, cells in rows]).reshape(
            -1, len(names)
        )

    names = tuple(cells[columns.index("name")] if "name" in columns else "" for _, cells in rows)
    sd = values(["sd"])[:, 0] if "sd" in columns else None
    if wanted == PLAIN:
        return Points(_in_ras(values(PLAIN), system, path), names, sd)
    fixed, moving, *second = (_in_ras(values(wanted[k : k + 3]), system, path) for k in range(0, len(wanted), 3))
    return PointPairs(fixed, moving, names, sd, *second)


def _read_fcsv(text: str, path: str, space: Space | None) -> Points:
    system, columns, points, names = _space_of(text, space, path), ["id", "x", "y", "z"], [], []
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            columns = [c.strip() for c in value.split(",")] if key.strip() == "columns" else columns
            if not set(PLAIN) <= set(columns):
                raise InputError(f"{path}, line {number}: expected columns x, y, z; got {', '.join(columns)}")
        elif line.strip():
            cells = next(csv.reader([line]))
            if len(cells) < 4:
                raise InputError(f"{path}, line {number}: expected four columns or more, got {len(cells)}")
            where = [columns.index(axis) for axis in PLAIN]
            if len(cells) <= max(where):
                raise InputError(f"{path}, line {number}: expected {max(where) + 1} columns or more, got {len(cells)}")
            points.append([_number(cells[k], f"{path}, line {number}") for k in where])
            label = columns.index("label") if "label" in columns else len(cells)
            names.append(cells[label] if label < len(cells) else "")
    return Points(_in_ras(points, system, path), tuple(names))


def _read_markups(text: str, path: str, space: Space | None) -> Points:
    _require_unsaid(space, path)
    try:
        markups = json.loads(text)["markups"]
    except (json.JSONDecodeError, KeyError, TypeError):
        raise InputError(f"{path} is no file of 3D Slicer's markups: expected JSON with the key markups") from None
    points: list[np.ndarray] = []
    names: list[str] = []
    undefined: list[int] = []
    for markup in _require_objects(markups, "markups", path):
        if markup.get("coordinateUnits", "mm") not in ("mm", ["mm", "UCUM", "millimeter"]):
            raise InputError(f"{path}: expected coordinates in mm, got {markup['coordinateUnits']!r}")
        controls = _require_objects(markup.get("controlPoints", []), "controlPoints", path)
        are_placed = [point.get("positionStatus", "defined") == "defined" for point in controls]
        undefined += [len(names) + k for k, is_placed in enumerate(are_placed) if not is_placed]
        positions = [
            _position(point, path) if is_placed else [0.0] * 3
            for point, is_placed in zip(controls, are_placed, strict=True)
        ]
        points.append(_in_ras(positions, str(markup.get("coordinateSystem", "LPS")), path))
        names += [str(point.get("label", "")) for point in controls]
    placed = np.concatenate(points) if points else np.zeros((0, 3))
    return Points(placed, tuple(names), undefined=tuple(undefined))


def _require_objects(value: Any, key: str, path: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise InputError(f"{path}: expected {key} to be a list of JSON objects, got {value!r:.60}")
    return value


def _position(point: Any, path: str) -> list[float]:
    position = point.get("position")
    if not isinstance(position, list) or len(position) != 3:
        raise InputError(f"{path}: a control point needs a position of three numbers, got {position!r:.60}")
    return [_number(value, path) for value in position]


def _read_tag(text: str, path: str, space: Space | None) -> Points | PointPairs:
    """Read MNI's tag points; a row has three RAS coordinates per volume, and optionally a weight, ids and a label."""
    _require_unsaid(space, path)
    plain = "\n".join("" if line.lstrip().startswith("%") else line for line in text.splitlines())
    volumes, body = re.search(r"Volumes\s*=\s*(\d+)\s*;", plain), re.search(TAG_ROWS, plain)
    if not plain.lstrip().startswith("MNI Tag Point File") or volumes is None or body is None:
        raise InputError(f"{path} is no MNI tag file: expected 'MNI Tag Point File', 'Volumes = 2;' and 'Points = …;'")
    count = int(volumes[1])
    if count not in (1, 2):
        raise InputError(f"{path}: expected tags of one or two volumes, got {count}")
    rows, names = [], []
    for number, line in enumerate(body[1].split("\n"), 1 + plain.count("\n", 0, body.start(1))):
        if line.strip():
            row, name = _tag_row(line, 3 * count, f"{path}, line {number}")
            rows.append(row)
            names.append(name)
    table = np.array(rows, float).reshape(-1, 3 * count)
    if count == 1:
        return Points(table, tuple(names))
    return PointPairs(table[:, :3], table[:, 3:], tuple(names))


def _tag_row(line: str, wanted: int, where: str) -> tuple[list[float], str]:
    """Read the coordinates and the label of a row; a weight, two ids and a comment are optional and ignored."""
    numbers, *quoted = re.split(r'"([^"]*)"', line)
    if "%" in numbers:
        numbers, quoted = numbers.partition("%")[0], []
    cells = numbers.split()
    if len(cells) not in (wanted, wanted + 3):
        raise InputError(
            f"{where}: expected {wanted} coordinates, and a weight and two ids or none; got {len(cells)} values"
        )
    if len(quoted) > 1 and "".join(quoted[1:]).strip():
        raise InputError(f"{where}: expected one point a line, got more after the label {quoted[0]!r:.40}")
    return [_number(cell, where) for cell in cells[:wanted]], quoted[0] if quoted else ""


def _space_of(text: str, space: Space | None, path: str) -> str:
    """Choose the space that a file names, or else the given one, or else RAS."""
    named = _named_system(text, "", path)
    if named in SYSTEMS and space and not np.array_equal(SYSTEMS[named], SYSTEMS[space]):
        raise InputError(f"{path} says that its coordinates are {named}, and {space} is given: leave the space out")
    return named or space or "RAS"


def _require_unsaid(space: Space | None, path: str) -> None:
    if space is not None:
        raise InputError(f"{path} says itself whether its coordinates are RAS or LPS: leave the space out")


def _named_system(text: str, default: str, path: str) -> str:
    """Read the coordinate system from a line such as `# CoordinateSystem = LPS`."""
    comments = "\n".join(re.findall(r"^\s*#.*$", text, re.MULTILINE))
    named = re.findall(r"Coordinate\s*System\s*[=:]\s*(.*?)[\s,]*$", comments, re.MULTILINE | re.IGNORECASE)
    if not named and re.search(r"\bLPS\b|Coordinate\s*System", comments, re.IGNORECASE):
        raise InputError(f"{path}: a comment speaks of its coordinate system; write it as '# CoordinateSystem = LPS'")
    return str(named[-1]).upper() if named else default


def _in_ras(points: Sequence[Sequence[float]] | np.ndarray, system: str, path: str) -> Float[np.ndarray, "k 3"]:
    if system not in SYSTEMS:
        raise InputError(f"{path}: unknown coordinate system {system!r}; known are {', '.join(SYSTEMS)}")
    return np.array(points, float).reshape(-1, 3) * SYSTEMS[system]


def _number(value: Any, where: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{where}: expected a number, got {value!r:.40}") from None


READERS: dict[str, Callable[[str, str, Space | None], Points | PointPairs]] = {
    ".csv": _read_csv,
    ".fcsv": _read_fcsv,
    ".mrk.json": _read_markups,
    ".tag": _read_tag,
}
