"""Export of a run as a scene of 3D Slicer, in the world of the moving image, in which surgery takes place."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from bayesreg.io.slicer import Item, write_markups, write_scene
from bayesreg.io.surface_files import save_ellipsoids, save_surface
from bayesreg.io.volumes import save_image
from bayesreg.results.apply import require_folder
from bayesreg.results.displacement_fields import MEAN_INVERSE
from bayesreg.results.maps import maps
from bayesreg.results.nodal_draws import transform_of
from bayesreg.results.result import Result, load_result
from bayesreg.results.transform import Transform, distances_of, spread
from bayesreg.types import InputError

SCENE, BACK = "scene.mrml", "moving to fixed"


def slicer(folder: str | Path, out: str | Path) -> Path:
    """Write a folder that 3D Slicer opens: images, transform, uncertainty, mesh, and points with their ellipsoids.

    Parameters
    ----------
    folder : path
        The folder of a run.
    out : path
        The output folder; files of the same names are replaced.

    Returns
    -------
    Path
        The path of the scene. In the scene, the inverse of the posterior mean resamples the fixed image and the maps of
        uncertainty in the moving image's world. The mesh's surface is moved by the posterior mean, with the 95 % radius
        of its points, mm. The report's points and the landmarks are moved likewise, each with the ellipsoid that holds
        it with 95 % probability.

    Raises
    ------
    InputError
        If the folder holds no run, or a run without transforms.
    """
    result, out = load_result(folder), require_folder(out)
    if not (result.folder / MEAN_INVERSE).is_file():
        raise InputError(f"{folder} holds no {MEAN_INVERSE}: the run was made by an earlier version; run anew")
    out.mkdir(parents=True, exist_ok=True)
    transform = transform_of(result)
    items = [Item("transform", BACK, MEAN_INVERSE)]
    shutil.copyfile(result.folder / MEAN_INVERSE, out / MEAN_INVERSE)
    items += _write_images(result, out)
    maps(folder, out, far=())
    items += [
        Item("volume", "95 % radius, mm", "radius95.nii.gz", BACK),
        Item("volume", "volume after over before", "jacobian_mean.nii.gz", BACK),
        Item("volume", "its standard deviation", "jacobian_sd.nii.gz", BACK),
        Item("volume", "P(inside out)", "p_inverted.nii.gz", BACK),
    ]
    items += _write_mesh(transform, out)
    items += _write_places(result, transform, out)
    write_scene(out / SCENE, items)
    return out / SCENE


def _write_images(result: Result, out: Path) -> list[Item]:
    run = result.run
    if run.fixed is None or run.moving is None:
        return []
    save_image(run.fixed, out / "fixed.nii.gz")
    moving = run.matching.pose.inverse.aligned(run.moving)
    save_image(moving if run.matching.scale is None else run.matching.scale.undo(moving), out / "moving.nii.gz")
    return [Item("volume", "moving", "moving.nii.gz"), Item("volume", "fixed", "fixed.nii.gz", BACK)]


def _write_mesh(transform: Transform, out: Path) -> list[Item]:
    """Write the surface of the organ, moved by the posterior mean."""
    mesh = transform.mesh
    posterior = spread(transform, mesh.points[mesh.boundary])
    faces = np.searchsorted(mesh.boundary, mesh.boundary_faces)
    save_surface(out / "surface.vtk", posterior.places, faces, {"radius95": distances_of(posterior.covariance).radius})
    return [Item("model", "organ", "surface.vtk", colour=(0.9, 0.75, 0.65, 0.3))]


def _write_places(result: Result, transform: Transform, out: Path) -> list[Item]:
    """Write the report's points, and the observed and held-out landmarks, with their ellipsoids."""
    predicted, items = result.run.predicted, []
    if predicted is None:
        return []
    kinds = {"places": (predicted.place_names, predicted.place_points)}
    for name in result.run.manifest["observations"]:
        arrays = predicted.of_observation(name)
        if {"names", "points"} <= set(arrays):
            kinds[name] = (np.asarray(arrays["names"]), arrays["points"])
    if predicted.evaluation_names is not None and predicted.evaluation_points is not None:
        inside = np.asarray(predicted.evaluation_inside)
        if inside.any():
            kinds["held_out"] = (predicted.evaluation_names[inside], np.asarray(predicted.evaluation_points)[inside])
    for name, (labels, points) in kinds.items():
        posterior = spread(transform, np.asarray(points))
        write_markups(out / f"{name}.mrk.json", [str(label) for label in labels], posterior.places)
        save_ellipsoids(out / f"{name}_95.vtk", posterior.places, *posterior.ellipsoids())
        items += [
            Item("markups", name, f"{name}.mrk.json"),
            Item("model", f"{name}, 95 %", f"{name}_95.vtk", colour=(0.9, 0.5, 0.1, 0.5)),
        ]
    return items
