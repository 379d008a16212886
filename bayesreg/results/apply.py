"""Transformation of points, surfaces, images and labels from the fixed image's world to the moving one's, or back."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.io.point_formats import Points
from bayesreg.io.points import read_side, write_table
from bayesreg.io.surface_files import Space, SurfaceFile, read_surface, save_outline, write_surface
from bayesreg.io.volumes import load_image, load_whole_numbers, save_image, write_nifti
from bayesreg.results.carried_labels import carry_labels
from bayesreg.results.displacement_fields import around_displaced
from bayesreg.results.nodal_draws import POINT_DRAWS, transform_of
from bayesreg.results.readings import own_grids, suspect_other_reading
from bayesreg.results.result import Result, load_result
from bayesreg.results.transform import Spread, Transform, distances_of, spread
from bayesreg.types import InputError

_log = logging.getLogger(__name__)

Around = Literal["harmonic", "missing"]

# Default number of draws of all chains together for labels, which take longer than points (`POINT_DRAWS`).
LABEL_DRAWS = 200
# Fewer draws than this cause a warning.
FEW_DRAWS = 30
# A point outside the margin of a label has this label with at most 1 minus this probability.
MARGIN = 0.95


def apply(
    folder: str | Path,
    out: str | Path,
    *,
    points: str | Path | None = None,
    image: str | Path | None = None,
    labels: str | Path | None = None,
    mesh: str | Path | None = None,
    inverse: bool = False,
    around: Around = "harmonic",
    like: str | Path | None = None,
    far: Sequence[float] = (2.0,),
    draws: int | None = None,
    space: Space | None = None,
    margins: Sequence[int] = (),
) -> list[Path]:
    """Transform points, an image, labels or a surface from the fixed to the moving image's world by the posterior.

    Parameters
    ----------
    folder : path
        The folder of a run.
    out : path
        The output folder; files of the same names are replaced.
    points : path, optional
        CSV with columns x, y, z (world RAS, mm), .fcsv, .mrk.json or .tag. The output points.csv has the transformed
        points by the posterior mean (mm), their covariance (mm²), the radius of the ball that holds a point with 95 %
        probability (mm), the half-axes (mm) and axes of the ellipsoid that does so, and P(distance from the posterior
        mean > d) for each distance d. Around the mesh, where nothing is observed, all columns except the coordinates
        are NaN.
    image : path, optional
        An image. The posterior mean transforms it with linear interpolation to the grid of the image of the other
        world.
    labels : path, optional
        Whole numbers. The output is the most probable label of each voxel, and a folder with the probability of every
        label.
    mesh : path, optional
        A surface or lines (.vtk, .vtp, .vtu, .stl, .ply, .obj). The output is the surface moved by the posterior mean,
        with the values of points.csv at its points.
    inverse : bool
        Whether to transform from the moving image's world to the fixed one's.
    around : "harmonic" or "missing"
        Treatment of the region around the mesh: the displacement continues harmonically
        (`bayesreg.fem.surroundings`), or values are missing (NaN; label 0; points of a surface are removed).
    like : path, optional
        An image whose grid the output images and labels have.
    far : sequence of float
        The distances d, mm.
    draws : int, optional
        Largest number of draws; the default is 1,000, for labels 200.
    space : "RAS" or "LPS", optional
        The space of the coordinates in `points` and `mesh`, if a file does not state it.
    margins : sequence of int
        Labels. For each a surface (.vtk, RAS) is written; every point outside it has the label with less than 5 %
        probability.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    InputError
        If nothing is given to transform, or a file is invalid.
    """
    inputs = {"points": points, "image": image, "labels": labels, "mesh": mesh}
    _require_sense(inputs, around, far, draws, margins)
    result, out = load_result(folder), require_folder(out)
    how = _How(out, "fixed" if inverse else "moving", around, tuple(far))
    _require_own_names(how, inputs, like)
    # All input is read before the long computation, so that errors appear early.
    tasks: list[Callable[[Transform], list[Path]]] = []
    if points is not None:
        side: Literal["fixed", "moving"] = "moving" if inverse else "fixed"
        given = read_side(points, side, space)
        tasks.append(partial(_carry_points, given, Path(points), own_grids(result, side), how))
    if mesh is not None:
        tasks.append(partial(_carry_surface, read_surface(mesh, space), Path(mesh), how))
    if image is not None:
        tasks.append(partial(_carry_image, load_image(image), _grid(result, like, inverse), Path(image), how))
    if labels is not None:
        label_image = load_whole_numbers(labels)
        if not np.asarray(label_image.voxels).any():
            raise InputError(f"{labels} holds no label: all its voxels are zero")
        if absent := sorted(set(margins) - set(np.unique(label_image.voxels).tolist())):
            raise InputError(f"label {absent[0]}, of which a margin is wanted, is not in {labels}")
        grid, most = _grid(result, like, inverse), draws or LABEL_DRAWS
        tasks.append(partial(_carry_labels, label_image, grid, Path(labels), how, margins, most))
    how.out.mkdir(parents=True, exist_ok=True)
    transform = transform_of(result, draws or (LABEL_DRAWS if points is None and mesh is None else POINT_DRAWS))
    transform = transform.inverse if inverse else transform
    _log.info("%s", _describe(transform))
    if len(transform.draws) < FEW_DRAWS:
        _log.warning("%d draws give a rough uncertainty; %d are few", len(transform.draws), FEW_DRAWS)
    return [path for task in tasks for path in task(transform)]


def _require_sense(
    inputs: Mapping[str, Any], around: str, far: Sequence[float], draws: int | None, margins: Sequence[int]
) -> None:
    """Raise InputError if the options contradict each other."""
    if all(path is None for path in inputs.values()):
        raise InputError("there is nothing to carry: give points, an image, labels or a mesh")
    if around not in get_args(Around):
        raise InputError(f"around is one of {', '.join(get_args(Around))}, got {around!r}")
    if margins and inputs["labels"] is None:
        raise InputError("a margin is that of a label: give labels, too")
    if 0 in margins:
        raise InputError("a margin is that of a label, and zero stands for no label")
    if draws is not None and draws < 2:
        raise InputError(f"expected at least two draws, got {draws}")
    require_distances(far)


def require_distances(far: Sequence[float]) -> None:
    """Raise InputError if a distance is not above zero."""
    if any(not distance > 0 for distance in far):
        raise InputError(f"expected distances above zero, mm, got {', '.join(map(str, far))}")


def require_folder(out: str | Path) -> Path:
    """Return the path of an output folder; raise InputError if it is a file or is not writable."""
    out = Path(out)
    nearest = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"nothing can be written to {out}: {nearest} is no folder that you may write")
    return out


def _require_own_names(how: _How, inputs: Mapping[str, str | Path | None], like: str | Path | None) -> None:
    """Raise InputError if an output would replace an input or another output."""
    targets: dict[Path, str] = {}
    input_paths = {Path(path).resolve() for path in (*inputs.values(), like) if path is not None}
    for kind, path in inputs.items():
        if path is None:
            continue
        target = how.target(kind, Path(path))
        if target.resolve() in input_paths:
            raise InputError(f"{target} would be replaced by what is made of {path}; name another folder")
        if target in targets:
            raise InputError(f"{targets[target]} and {path} would both be carried to {target}; carry one at a time")
        targets[target] = str(path)


class _How(NamedTuple):
    """The options that points, surfaces, images and labels share."""

    out: Path
    where: str
    around: Around
    far: tuple[float, ...]

    def target(self, kind: str, source: Path) -> Path:
        """Build the path of the output for a source file."""
        if kind == "points":
            return self.out / "points.csv"
        return self.name(source, source.suffix if kind == "mesh" else ".nii.gz")

    def name(self, source: Path, end: str) -> Path:
        """Build the path of a file that is named after a source file."""
        stem = Path(source.name.removesuffix(".gz")).stem
        return self.out / f"{stem or 'image'}_in-{self.where}{end}"

    def tell_of_outside(self, inside: Bool[np.ndarray, "k"], noun: str) -> None:
        """Log how many points lie around the mesh, where nothing was observed."""
        if inside.all():
            return
        then = "the displacement goes on harmonically" if self.around == "harmonic" else "no place is given"
        count = f"{int((~inside).sum()):,} of {len(inside):,}"
        _log.info("%s %s lie around the mesh, where nothing is known: %s; no uncertainty is given", count, noun, then)


def _describe(transform: Transform) -> str:
    """Describe the direction of a transform and its draws in words."""
    ways = (
        "the moving image to that of the fixed one" if transform.turned else "the fixed image to that of the moving one"
    )
    text = f"from the world of {ways}, by {len(transform.draws):,} draws"
    if transform.folded:
        text += f"; {transform.folded:.1%} of them turn tetrahedra inside out, where a place has several sources"
    return text


def _grid(result: Result, like: str | Path | None, inverse: bool) -> Image:
    """Choose the grid on which images and labels are written."""
    if like is not None:
        return load_image(like)
    run = result.run
    if inverse:
        return run.background
    if run.moving is None:
        # Without a moving image the grid must hold the displaced organ.
        return around_displaced(run.background, run.matching.pose.place(run.mesh.points + run.u_mean))
    return run.matching.pose.inverse.aligned(run.moving)


def _carry_points(
    points: Points, path: Path, grids: Mapping[str, Image], how: _How, transform: Transform
) -> list[Path]:
    posterior = spread(transform, points.points, how.far)
    how.tell_of_outside(posterior.inside, f"points of {path}")
    if suspicion := suspect_other_reading(points.points, grids, transform):
        _log.warning("%s: %s", path, suspicion)
    columns: dict[str, Any] = {"name": points.names}
    for name, values in _values(posterior, how).items():
        axes = [name] if values.ndim == 1 else [f"{name}{end}" for end in ENDS[name]]
        columns |= dict(zip(axes, values.reshape(len(values), -1).T, strict=True))
    write_table(target := how.target("points", path), columns)
    return [target]


def _carry_surface(surface: SurfaceFile, path: Path, how: _How, transform: Transform) -> list[Path]:
    if not surface.is_said:
        _log.info("%s does not say whether its coordinates are RAS or LPS (--space); they are taken as RAS", path)
    posterior = spread(transform, surface.points, how.far)
    how.tell_of_outside(posterior.inside, f"points of {path}")
    if how.around == "missing":
        if not posterior.inside.any():
            raise InputError(f"no point of {path} lies in the mesh, and what lies around it is to be left out")
        surface, posterior = surface.selected(posterior.inside), posterior.selected(posterior.inside)
    values = _values(posterior, how)
    write_surface(target := how.target("mesh", path), surface, values.pop(""), values)
    return [target]


# The suffixes of columns of quantities that have several components.
ENDS = {
    "": ("x", "y", "z"),
    "cov_": ("xx", "xy", "xz", "yy", "yz", "zz"),
    "half_axis95_": ("1", "2", "3"),
    "axis": tuple(f"{axis}_{end}" for axis in "123" for end in "xyz"),
}


def _values(posterior: Spread, how: _How) -> dict[str, np.ndarray]:
    """Collect the coordinates of every point and the measures of its uncertainty, by column name."""
    lengths, directions = posterior.ellipsoids()
    row, column = np.triu_indices(3)
    places = (
        posterior.places if how.around == "harmonic" else np.where(posterior.inside[:, None], posterior.places, np.nan)
    )
    values = {
        "": places,
        "cov_": posterior.covariance[:, row, column],
        "radius95": distances_of(posterior.covariance).radius,
    }
    values |= {"half_axis95_": lengths, "axis": directions.reshape(-1, 9)}
    values |= {f"p_over_{distance:g}mm": share for distance, share in zip(how.far, posterior.far, strict=True)}
    return values | {"in_mesh": posterior.inside.astype(float)}


def _carry_image(image: Image, grid: Image, path: Path, how: _How, transform: Transform) -> list[Path]:
    """Transform an image by the posterior mean with linear interpolation; voxels from beyond its grid are zero."""
    inverse, voxels = transform.inverse, np.empty(int(np.prod(grid.shape)), np.float32)
    inside, intensities = np.empty(len(voxels), bool), np.asarray(image.voxels, float)
    for block, places in grid.blocks():
        source, location = inverse.place(places)
        # As in ITK, the outermost half voxel takes the nearest value; beyond it the result is zero.
        index = image.world_to_voxel(source).T
        values = ndimage.map_coordinates(intensities, index, order=1, mode="nearest")
        voxels[block] = np.where(image.contains(source), values, 0.0)
        inside[block] = inverse.deformer.is_inside(location) & image.contains(source)
    _tell_of_nothing(inside, path, how)
    if how.around == "missing":
        voxels[~inside] = np.nan
    write_nifti(voxels.reshape(grid.shape), grid.affine, target := how.target("image", path))
    return [target]


def _tell_of_nothing(inside: Bool[np.ndarray, "k"], path: Path, how: _How) -> None:
    if not inside.any():
        _log.warning("nothing of %s comes from within the mesh; is it in the world of the other image?", path)


def _carry_labels(
    labels: Image, grid: Image, path: Path, how: _How, margins: Sequence[int], most: int, transform: Transform
) -> list[Path]:
    count = min(len(transform.draws), most)
    thinned = replace(transform, draws=transform.draws[np.linspace(0, len(transform.draws) - 1, count).astype(int)])
    _log.info("labels of %s, by %d draws", path, len(thinned.draws))
    carried = carry_labels(thinned, labels, grid, keep_around=how.around == "harmonic")
    _tell_of_nothing(np.asarray(carried.most_probable.voxels).ravel() != 0, path, how)
    save_image(carried.most_probable, target := how.target("labels", path))
    folder = how.name(path, "_probability")
    folder.mkdir(exist_ok=True)
    # An earlier call with a file of this name may have left probabilities of other labels.
    for stale in folder.glob("label-*.nii.gz"):
        stale.unlink()
    written = [target]
    for value, probability in carried.probabilities():
        write_nifti(probability, grid.affine, probability_file := folder / f"label-{value}.nii.gz")
        written.append(probability_file)
        if value in margins and not (np.nan_to_num(probability) > 1 - MARGIN).any():
            _log.warning("label %d is improbable everywhere, and has no margin", value)
        elif value in margins:
            target = how.name(path, f"_margin95_label-{value}.vtk")
            save_outline(target, np.nan_to_num(probability), grid.affine, 1 - MARGIN)
            written.append(target)
    return written
