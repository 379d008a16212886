"""Read points and pairs of points, and write tables of points; world RAS, mm."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from bayesreg.io.atomic import write_text
from bayesreg.io.point_formats import READERS, PointPairs, Points
from bayesreg.io.spaces import Space
from bayesreg.printable import join_some, require_printable
from bayesreg.types import InputError

_log = logging.getLogger(__name__)


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
    return points.defined


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
    if isinstance(points, PointPairs):
        return Points(getattr(points, side), points.names, points.sd)
    return points.defined


def write_table(path: str | Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Write columns of equal length as CSV, in one step; numbers have six decimals."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([value if isinstance(value, str) else f"{value:.6f}" for value in row])
    write_text(path, lines.getvalue())


def read_point_pairs(
    path: str | Path, moving: str | Path | None = None, second: str | Path | None = None
) -> PointPairs:
    """Read pairs of points, from one file or from two, and the moving points as read again, if there are any.

    Parameters
    ----------
    path : path
        Both points of each pair (CSV, or a .tag of two volumes), or the points in the fixed image.
    moving : path, optional
        The points in the moving image. They are paired by name if the names are unique in each file and both files have
        the same names. They are paired in order if names repeat or the files share no name. Unique names of which only
        some agree are an error. Points without a position (Slicer's `positionStatus`) are left out with their partners,
        once pairs are made.
    second : path, optional
        The points in the moving image as read a second time, one for each pair: by name or in order likewise. A CSV of
        pairs may have them in its columns second_x, second_y, second_z.

    Raises
    ------
    InputError
        If a file is missing or of an unknown kind, its content is invalid, or the files do not fit each other.
    """
    pairs = _read_once(path, moving)
    return pairs if second is None else _with_second(pairs, path, second)


def _with_second(pairs: PointPairs, path: str | Path, second: str | Path) -> PointPairs:
    if pairs.second is not None:
        raise InputError(f"{path} has the columns of a second reading; expected no second file, got {second}")
    again = read_points(second)
    _, partners = _partners(Points(pairs.moving, pairs.names), again, path, second)
    return pairs._replace(second=again.points[partners])


def _read_once(path: str | Path, moving: str | Path | None) -> PointPairs:
    """Read pairs of points, from one file or from two."""
    points = _read(Path(path))
    if isinstance(points, PointPairs):
        if moving is not None:
            raise InputError(f"{path} holds both points of each pair; expected no second file, got {moving}")
        return points
    if moving is None:
        raise InputError(
            f"{path} holds points of one space; give the points of the moving image, too (in YAML, moving_file beside "
            "file), or a CSV with the columns fixed_x, fixed_y, fixed_z, moving_x, moving_y, moving_z"
        )
    moving_points = _read(Path(moving))
    if isinstance(moving_points, PointPairs):
        raise InputError(f"{moving} holds pairs of points; expected points of one space")
    if moving_points.sd is not None:
        raise InputError(f"{moving} gives an sd; expected it in the file of the fixed points, {path}, for each pair")
    first, second = _partners(points, moving_points, path, moving)
    are_defined = ~(np.isin(first, points.undefined) | np.isin(second, moving_points.undefined))
    _tell_left_out(points, moving_points, path, moving)
    first, second = first[are_defined], second[are_defined]
    if not len(first):
        raise InputError(f"{path} and {moving} hold no pair of which both points have a position")
    names = tuple(points.names[k] for k in first)
    sd = None if points.sd is None else points.sd[first]
    return PointPairs(points.points[first], moving_points.points[second], names, sd)


def _partners(
    fixed_points: Points, moving_points: Points, path: str | Path, moving: str | Path
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Find the numbers of both points of each pair; a point without a position need not have a partner."""
    sides = fixed_points, moving_points
    names, others = (points.names for points in sides)
    unique = all(len(set(points.names)) == len(points.names) for points in sides)
    if unique and set(names) & set(others) - {""}:
        without_position = {points.names[k] for points in sides for k in points.undefined}
        if alone := sorted((set(names) ^ set(others)) - without_position):
            raise InputError(
                f"{path} and {moving} share some names only; {alone[0]!r} stands in one of them: give both the same "
                "names"
            )
        pairs = [(k, others.index(name)) for k, name in enumerate(names) if name in others]
        return np.array([k for k, _ in pairs], int), np.array([j for _, j in pairs], int)
    if len(names) != len(others):
        counts = [f"{len(points.names)} points" + _describe_undefined(points) for points in sides]
        raise InputError(f"{path} holds {counts[0]} and {moving} {counts[1]}: they are no pairs")
    return np.arange(len(names)), np.arange(len(names))


def _describe_undefined(points: Points) -> str:
    return f" ({len(points.undefined)} without a position)" if points.undefined else ""


def _tell_left_out(fixed_points: Points, moving_points: Points, path: str | Path, moving: str | Path) -> None:
    """Log which points have no position, so that their pairs are left out."""
    for points, file in ((fixed_points, path), (moving_points, moving)):
        if points.undefined:
            named = join_some([points.names[k] or f"number {k + 1}" for k in points.undefined])
            _log.warning("%s: points without a position are left out with their partners: %s", file, named)


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


def _places(pairs: PointPairs) -> Float[np.ndarray, "k coordinates"]:
    return np.hstack([side for side in (pairs.fixed, pairs.moving, pairs.second) if side is not None])


def _require_sound(points: Points | PointPairs, path: Path) -> None:
    places = points.defined.points if isinstance(points, Points) else _places(points)
    if not len(places):
        undefined = len(points.undefined) if isinstance(points, Points) else 0
        raise InputError(f"{path} holds no point" + f" with a position, and {undefined} without one" * bool(undefined))
    require_printable(points.names, str(path))
    if not np.isfinite(places).all():
        raise InputError(f"{path}: point {1 + int(np.argwhere(~np.isfinite(places))[0, 0])} is not finite")
    if points.sd is not None and len(bad := np.flatnonzero(~(np.isfinite(points.sd) & (points.sd > 0)))):
        raise InputError(
            f"{path}: every sd must be a positive number of mm, got {points.sd[bad[0]]:g} at point {bad[0] + 1}"
        )
