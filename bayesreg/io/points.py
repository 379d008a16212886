"""Read points and pairs of points, and write tables of points; world RAS, mm."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bayesreg.io.atomic import write_text
from bayesreg.io.point_formats import READERS, PointPairs, Points
from bayesreg.io.spaces import Space
from bayesreg.printable import require_printable
from bayesreg.types import InputError


def read_points(path: str | Path) -> Points:
    """Read points of one space.

    Raises
    ------
    InputError
        If the file is missing or of an unknown kind, or its content is invalid.
    """
    points = _read(Path(path))
    if isinstance(points, PointPairs):
        raise InputError(f"{path} holds pairs of points; expected points of one space")
    return points


def read_side(path: str | Path, side: Literal["fixed", "moving"], space: Space | None = None) -> Points:
    """Read points of one space, or one side of a file of pairs.

    Parameters
    ----------
    path : path
    side : "fixed" or "moving"
    space : "RAS" or "LPS", optional
        The space of a CSV or .fcsv that does not state it; the default is RAS.

    Raises
    ------
    InputError
        As in `read_points`; also if the file states another space, or if it has the columns of ANTs, which writes
        points in LPS, and no space is given.
    """
    points = _read(Path(path), space)
    return Points(getattr(points, side), points.names, points.sd) if isinstance(points, PointPairs) else points


def write_table(path: str | Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Write columns of equal length as CSV, in one step; numbers have six decimals."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([value if isinstance(value, str) else f"{value:.6f}" for value in row])
    write_text(path, lines.getvalue())


def read_point_pairs(path: str | Path, moving: str | Path | None = None) -> PointPairs:
    """Read pairs of points, from one file or from two.

    Parameters
    ----------
    path : path
        Both points of each pair (CSV, or a .tag of two volumes), or the points in the fixed image.
    moving : path, optional
        The points in the moving image. They are paired by name if the names are unique in each file and both files have
        the same names. They are paired in order if names repeat or the files share no name. Unique names of which only
        some agree are an error.

    Raises
    ------
    InputError
        If a file is missing or of an unknown kind, its content is invalid, or the files do not fit each other.
    """
    points = _read(Path(path))
    if isinstance(points, PointPairs):
        if moving is not None:
            raise InputError(f"{path} holds both points of each pair; expected no second file, got {moving}")
        return points
    if moving is None:
        raise InputError(
            f"{path} holds points of one space; give the points of the moving image, too, or a CSV with the columns "
            "fixed_x, fixed_y, fixed_z, moving_x, moving_y, moving_z"
        )
    moving_points = read_points(moving)
    if moving_points.sd is not None:
        raise InputError(f"{moving} gives an sd; expected it in the file of the fixed points, {path}, for each pair")
    if len(moving_points.points) != len(points.points):
        raise InputError(
            f"{path} holds {len(points.points)} points and {moving} {len(moving_points.points)}: they are no pairs"
        )
    return PointPairs(
        points.points,
        moving_points.points[_order(points, moving_points, f"{path} and {moving}")],
        points.names,
        points.sd,
    )


def _order(fixed_points: Points, moving_points: Points, files: str) -> list[int]:
    """Find the index in the other file of the partner of each point."""
    names, others = fixed_points.names, moving_points.names
    unique = len(set(names)) == len(names) and len(set(others)) == len(others)
    shared = set(names) & set(others) - {""}
    if not unique or not shared:
        return list(range(len(names)))
    if alone := sorted(set(names) ^ set(others)):
        raise InputError(f"{files} share some names only; {alone[0]!r} stands in one of them: give both the same names")
    return [others.index(name) for name in names]


def _read(path: Path, space: Space | None = None) -> Points | PointPairs:
    name = path.name.lower()
    suffix = next((suffix for suffix in READERS if name.endswith(suffix)), None)
    if suffix is None:
        raise InputError(f"{path}: unknown kind of file with points; known are {', '.join(READERS)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file with points")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text ({error.reason} at byte {error.start})") from None
    points = READERS[suffix](text, str(path), space)
    _require_sound(points, path)
    return points


def _require_sound(points: Points | PointPairs, path: Path) -> None:
    places = points.points if isinstance(points, Points) else np.hstack([points.fixed, points.moving])
    if not len(places):
        raise InputError(f"{path} holds no point")
    require_printable(points.names, str(path))
    if not np.isfinite(places).all():
        raise InputError(f"{path}: point {1 + int(np.argwhere(~np.isfinite(places))[0, 0])} is not finite")
    if points.sd is not None and len(bad := np.flatnonzero(~(np.isfinite(points.sd) & (points.sd > 0)))):
        raise InputError(
            f"{path}: every sd must be a positive number of mm, got {points.sd[bad[0]]:g} at point {bad[0] + 1}"
        )
