"""Carry points, surfaces, images and labels from the fixed image's world to the moving one's, or back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.config import model_of
from bayesreg.fem.deformation import Deformer
from bayesreg.image import Image
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io.points import Points, read_side, write_table
from bayesreg.io.surface_files import Space, SurfaceFile, read_surface, save_outline, write_surface
from bayesreg.io.volumes import load_image, load_whole_numbers, save_image, write_nifti
from bayesreg.transform import Spread, Transform, spread
from bayesreg.types import InputError
from bayesreg.workflow.assembly import nodal_draws
from bayesreg.workflow.carried_labels import carry_labels
from bayesreg.workflow.result import Result, load_result

Around = Literal["harmonic", "missing"]

# Draws of all chains together: of points, and of labels, which take longer.
POINT_DRAWS, LABEL_DRAWS = 1000, 200
# The probability with which a margin holds a label, point by point.
MARGIN = 0.95


def transform_of(result: Result, draws: int = POINT_DRAWS) -> Transform:
    """The transform of a run from the fixed image's world to the moving one's, with up to so many of its draws."""
    run = result.run
    # The files that the configuration names need not be there any more.
    u = nodal_draws(model_of(run.config), run, dataset(result.idata, "posterior"), draws)
    return Transform(Deformer(run.mesh), run.matching.pose, run.u_mean, u, seed=int(run.manifest["seed"]))


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
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Carry what lies in the world of the fixed image to that of the moving one, over the posterior.

    Parameters
    ----------
    folder : path
        Of a run.
    out : path
        A folder; files of the same names are replaced.
    points : path, optional
        CSV with columns x, y, z (world RAS, mm), .fcsv, .mrk.json or .tag. Writes points.csv: places by the posterior
        mean, covariance (mm²), half-axes and axes of the ellipsoid that holds 95 %, and P(further from there than so
        many mm).
    image : path, optional
        Carried by the posterior mean and interpolated linearly, on the grid of the image that shows the other world.
    labels : path, optional
        Whole numbers. Writes the most probable label of each voxel, and a folder with the probability of every label.
    mesh : path, optional
        A surface or lines (.vtk, .vtp, .vtu, .stl, .ply, .obj). Writes it where the posterior mean takes it, with the
        same values at its points as points.csv has.
    inverse : bool
        From the world of the moving image to that of the fixed one.
    around : "harmonic" or "missing"
        What becomes of all that lies around the mesh: carried on (`bayesreg.fem.surroundings`), or NaN (a label of 0).
    like : path, optional
        An image on whose grid images and labels are written.
    far : sequence of float
        Distances, mm.
    draws : int, optional
        How many at most; the default is 1,000, for labels 200.
    space : "RAS" or "LPS", optional
        Of the coordinates in `mesh`, where the file does not say it.
    margins : sequence of int
        Labels; of each a surface is written (.vtk, RAS) beyond which every point has it with less than 5 %.
    say : callable
        Told what is done, and beware of.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    InputError
        If nothing is given to carry, or a file is wrong.
    """
    given = {"points": points, "image": image, "labels": labels, "mesh": mesh}
    if margins and labels is None:
        raise InputError("a margin is that of a label: give labels, too")
    if all(path is None for path in given.values()):
        raise InputError("there is nothing to carry: give points, an image, labels or a mesh")
    if draws is not None and draws < 2:
        raise InputError(f"expected at least two draws, got {draws}")
    if any(not distance > 0 for distance in far):
        raise InputError(f"expected distances above zero, mm, got {', '.join(map(str, far))}")
    result, known = load_result(folder), [Path(path).absolute() for path in (*given.values(), like) if path is not None]
    how = _How(Path(out), "fixed" if inverse else "moving", around, tuple(far), frozenset(known), say)
    # All input is read before anything long begins.
    tasks: list[Callable[[Transform], list[Path]]] = []
    if points is not None:
        tasks.append(partial(_carry_points, read_side(points, "moving" if inverse else "fixed"), Path(points), how))
    if mesh is not None:
        tasks.append(partial(_carry_surface, read_surface(mesh, space), Path(mesh), how))
    if image is not None:
        tasks.append(partial(_carry_image, load_image(image), _grid(result, like, inverse), Path(image), how))
    if labels is not None:
        found = load_whole_numbers(labels)
        if absent := sorted(set(margins) - set(np.unique(found.voxels).tolist())):
            raise InputError(f"label {absent[0]}, of which a margin is wanted, is not in {labels}")
        grid, most = _grid(result, like, inverse), draws or LABEL_DRAWS
        tasks.append(partial(_carry_labels, found, grid, Path(labels), how, margins, most))
    how.out.mkdir(parents=True, exist_ok=True)
    transform = transform_of(result, draws or (LABEL_DRAWS if points is None and mesh is None else POINT_DRAWS))
    transform = transform.inverse if inverse else transform
    say(_describe(transform))
    return [path for task in tasks for path in task(transform)]


class _How(NamedTuple):
    """What all kinds have in common."""

    out: Path
    where: str
    around: Around
    far: tuple[float, ...]
    given: frozenset[Path]
    say: Callable[[str], None]

    def name(self, source: Path, suffix: str) -> Path:
        """The file for what was carried of another; InputError where that would replace what was given."""
        stem = source.name
        for known in (".gz", *source.suffixes[::-1]):
            stem = stem.removesuffix(known)
        return self.require_new(self.out / f"{stem or 'image'}_in-{self.where}{suffix}")

    def require_new(self, path: Path) -> Path:
        if path.absolute() in self.given:
            raise InputError(f"{path} would be replaced by what is made of it; name another folder")
        return path

    def tell_of_outside(self, inside: Bool[np.ndarray, "k"], what: str) -> None:
        """Say how much lies around the mesh, where nothing was observed."""
        if inside.all():
            return
        then = "the displacement goes on harmonically" if self.around == "harmonic" else "no place is given"
        self.say(
            f"{int((~inside).sum()):,} of {len(inside):,} {what} lie around the mesh, where nothing is known: {then}"
        )


def _describe(transform: Transform) -> str:
    """Where things are carried, and by what."""
    ways = (
        "the moving image to that of the fixed one" if transform.turned else "the fixed image to that of the moving one"
    )
    text = f"from the world of {ways}, by {len(transform.draws):,} draws"
    if transform.folded:
        text += f"; {transform.folded:.1%} of them turn tetrahedra inside out, where a place has several sources"
    return text


def _grid(result: Result, like: str | Path | None, inverse: bool) -> Image:
    """The grid that images and labels are carried to."""
    if like is not None:
        return load_image(like)
    run = result.run
    if run.moving is None or inverse:
        return run.background
    return run.matching.pose.inverse.aligned(run.moving)


def _carry_points(points: Points, path: Path, how: _How, transform: Transform) -> list[Path]:
    found = spread(transform, points.points, how.far)
    how.tell_of_outside(found.inside, f"points of {path}")
    columns: dict[str, Any] = {"name": points.names}
    for name, values in _values(found, how).items():
        axes = [name] if values.ndim == 1 else [f"{name}{end}" for end in ENDS[name]]
        columns |= dict(zip(axes, values.reshape(len(values), -1).T, strict=True))
    write_table(target := how.require_new(how.out / "points.csv"), columns)
    return [target]


def _carry_surface(surface: SurfaceFile, path: Path, how: _How, transform: Transform) -> list[Path]:
    if not surface.is_said:
        how.say(f"{path} does not say whether its coordinates are RAS or LPS (--space); they are taken as RAS")
    found = spread(transform, surface.points, how.far)
    how.tell_of_outside(found.inside, f"points of {path}")
    values = _values(found, how)
    write_surface(target := how.name(path, path.suffix), surface, values.pop(""), values)
    return [target]


# What stands behind the name of a column, for what has several.
ENDS = {
    "": ("x", "y", "z"),
    "cov_": ("xx", "xy", "xz", "yy", "yz", "zz"),
    "radius95_": ("1", "2", "3"),
    "axis": tuple(f"{axis}_{end}" for axis in "123" for end in "xyz"),
}


def _values(found: Spread, how: _How) -> dict[str, np.ndarray]:
    """What is told of every point: its place, and how sure that is."""
    lengths, directions = found.ellipsoids()
    one, other = np.triu_indices(3)
    values = {"": found.places, "cov_": found.covariance[:, one, other], "radius95_": lengths}
    values["axis"] = directions.reshape(-1, 9)
    values |= {f"p_over_{distance:g}mm": share for distance, share in zip(how.far, found.far, strict=True)}
    if how.around == "missing":
        values = {
            name: np.where(found.inside.reshape(-1, *(1,) * (x.ndim - 1)), x, np.nan) for name, x in values.items()
        }
    return values | {"in_mesh": found.inside.astype(float)}


def _carry_image(image: Image, grid: Image, path: Path, how: _How, transform: Transform) -> list[Path]:
    """By the posterior mean, linearly interpolated; zero where the image ends."""
    back, voxels = transform.inverse, np.empty(int(np.prod(grid.shape)), np.float32)
    inside, given = np.empty(len(voxels), bool), np.asarray(image.voxels, float)
    for some, places in grid.blocks():
        source, location = back.place(places)
        index = image.world_to_voxel(source).T
        voxels[some] = ndimage.map_coordinates(given, index, order=1, mode="grid-constant")
        inside[some] = back.deformer.is_inside(location)
    if how.around == "missing":
        voxels[~inside] = np.nan
    write_nifti(voxels.reshape(grid.shape), grid.affine, target := how.name(path, ".nii.gz"))
    return [target]


def _carry_labels(
    labels: Image, grid: Image, path: Path, how: _How, margins: Sequence[int], most: int, transform: Transform
) -> list[Path]:
    count = min(len(transform.draws), most)
    some = replace(transform, draws=transform.draws[np.linspace(0, len(transform.draws) - 1, count).astype(int)])
    how.say(f"labels of {path}, by {len(some.draws)} draws")
    found = carry_labels(some, labels, grid, keep_around=how.around == "harmonic")
    save_image(found.most_probable, target := how.name(path, ".nii.gz"))
    folder = how.name(path, "_probability")
    folder.mkdir(exist_ok=True)
    written = [target]
    for value, probability in found.probabilities():
        write_nifti(probability, grid.affine, part := folder / f"label-{value}.nii.gz")
        written.append(part)
        if value in margins:
            target = how.name(path, f"_margin95_label-{value}.vtk")
            save_outline(target, np.nan_to_num(probability), grid.affine, 1 - MARGIN)
            written.append(target)
    return written
