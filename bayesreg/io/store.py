"""The run folder: inputs, results, and the checkpoints that a killed run continues from."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayesreg.io.atomic import load_arrays, read_json, save_arrays, write_json, write_text
from bayesreg.io.displacements import read_point_data
from bayesreg.io.fields import save_displacement
from bayesreg.io.meshing import load_mesh, save_mesh
from bayesreg.io.points import PointPairs
from bayesreg.io.records import Channel, Inputs, Matching, Predicted, Run, Truth
from bayesreg.io.volumes import load_image, save_image
from bayesreg.types import AnyArray, InputError

BODIES = "bodies.json"
RESULTS = (
    "config.yaml", "run.json", "mesh.vtu", "posterior.nc", "draws", "state.npz", "inputs", "report.html", BODIES,
)  # fmt: skip
_BODY = {"seed", "true", "found", "failed"}


def require_fresh(folder: str | Path) -> None:
    """Raise InputError where a folder (or a file in its place) already holds a run, or cannot be written."""
    folder = Path(folder)
    nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if folder.exists() and not folder.is_dir():
        raise InputError(f"the output folder {folder} is a file; name a folder that is new or empty")
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"the output folder {folder} cannot be written: {nearest} is no folder that you may write")
    held = [name for name in RESULTS if (folder / name).exists()]
    if held:
        raise InputError(
            f"the output folder {folder} already holds a run ({', '.join(held)}); "
            "name another folder, or continue that run with --resume"
        )


def write_inputs(folder: str | Path, inputs: Inputs) -> None:
    """Write config.yaml, mesh.vtu and inputs/ into a folder, which is made if need be."""
    folder = Path(folder)
    images = folder / "inputs"
    images.mkdir(parents=True, exist_ok=True)
    every = ("fixed", "moving", "tissue", "skull", "fixed_ignore", "moving_ignore")
    given = {name: image for name in every if (image := getattr(inputs, name)) is not None}
    for name, channel in inputs.channels.items():
        given |= {f"channel-{name}-fixed": channel.fixed, f"channel-{name}-moving": channel.moving}
    # The compression lets other threads run.
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda name: save_image(given[name], images / f"{name}.nii.gz"), given))
    if inputs.truth is not None:
        known = {key: value for key, value in inputs.truth._asdict().items() if value is not None}
        save_arrays(images / "truth.npz", known)
    if inputs.boundary is not None:
        save_arrays(images / "boundary.npz", {"u_boundary": inputs.boundary})
    if inputs.points:
        save_arrays(images / "points.npz", _points_as_arrays(inputs.points))
    channels = {name: channel.one_contrast for name, channel in inputs.channels.items()}
    write_json(images / "matching.json", inputs.matching.as_json() | {"channels": channels})
    save_mesh(inputs.mesh, folder / "mesh.vtu")
    write_text(folder / "config.yaml", inputs.config)


def read_inputs(folder: str | Path) -> Inputs:
    """Read what `write_inputs` wrote; InputError where a part is missing or unreadable."""
    folder = Path(folder)
    images = folder / "inputs"
    config = _require(folder, "config.yaml").read_text(encoding="utf-8")
    mesh = load_mesh(_require(folder, "mesh.vtu"))
    tissue = load_image(_require(folder, "inputs/tissue.nii.gz"))
    fixed, moving, skull, fixed_ignore, moving_ignore = (
        load_image(path) if (path := images / f"{name}.nii.gz").exists() else None
        for name in ("fixed", "moving", "skull", "fixed_ignore", "moving_ignore")
    )
    if (fixed is None) != (moving is None):
        raise InputError(
            f"{folder} holds no finished run: inputs/{'fixed' if fixed is None else 'moving'}.nii.gz is missing"
        )
    known, given, points = images / "truth.npz", images / "boundary.npz", images / "points.npz"
    truth = Truth(**load_arrays(known, "run anew, into another folder")) if known.exists() else None
    boundary = load_arrays(given, "run anew, into another folder")["u_boundary"] if given.exists() else None
    pairs = _points_of(load_arrays(points, "run anew, into another folder")) if points.exists() else {}
    known_of_images = read_json(_require(folder, "inputs/matching.json"))
    channels = {name: _channel(folder, name, alike) for name, alike in known_of_images["channels"].items()}
    return Inputs(
        config, mesh, fixed, moving, tissue, skull, truth, boundary, pairs, Matching.of_json(known_of_images),
        fixed_ignore, moving_ignore, channels,
    )  # fmt: skip


def _channel(folder: Path, name: str, one_contrast: bool) -> Channel:
    fixed, moving = (
        load_image(_require(folder, f"inputs/channel-{name}-{which}.nii.gz")) for which in ("fixed", "moving")
    )
    return Channel(fixed, moving, one_contrast)


def _points_as_arrays(points: Mapping[str, PointPairs]) -> dict[str, AnyArray]:
    """Pairs of points as named arrays: "<observation>/<field>"."""
    fields = {(name, field): value for name, pairs in points.items() for field, value in pairs._asdict().items()}
    return {f"{name}/{field}": np.asarray(value) for (name, field), value in fields.items() if value is not None}


def _points_of(arrays: Mapping[str, np.ndarray]) -> dict[str, PointPairs]:
    found: dict[str, dict[str, Any]] = {}
    for key, value in arrays.items():
        name, field = key.split("/")
        found.setdefault(name, {})[field] = tuple(value.tolist()) if field == "names" else value
    return {name: PointPairs(**fields) for name, fields in found.items()}


def write_results(
    folder: str | Path,
    run: Run,
    displacement_mean: Float[np.ndarray, "X Y Z 3"],
    displacement_sd: Float[np.ndarray, "X Y Z 3"],
) -> None:
    """Write what a finished run adds to its inputs, run.json last.

    Parameters
    ----------
    folder : path
        Where `write_inputs` has written; files of the same names are replaced, each in one step.
    run : Run
    displacement_mean, displacement_sd : (X, Y, Z, 3) arrays
        Posterior mean and standard deviation of u on the grid of the background, world RAS, mm. The mean is
        written as a resampling transform (LPS vectors, intent 1007), the standard deviation as positive vectors.
    """
    folder = Path(folder)
    by_cell = {} if run.predicted is None else run.predicted.by_cell
    save_mesh(run.mesh, folder / "mesh.vtu", {"u_mean": run.u_mean, "u_sd": run.u_sd}, by_cell)
    if run.warped is not None:
        scale = run.matching.scale
        save_image(run.warped if scale is None else scale.undo(run.warped), folder / "warped_mean.nii.gz")
    affine = run.background.affine
    save_displacement(folder / "displacement_mean.nii.gz", displacement_mean, affine)
    # The writer turns x and y round, from RAS to LPS; a standard deviation has no sign to turn.
    unsigned = np.asarray(displacement_sd) * (-1.0, -1.0, 1.0)
    save_displacement(folder / "displacement_sd.nii.gz", unsigned, affine)
    if run.metrics is not None:
        write_json(folder / "metrics.json", run.metrics)
    if run.predicted is not None:
        save_arrays(folder / "predicted.npz", run.predicted.known)
    write_json(folder / "run.json", run.manifest)


def read_run(folder: str | Path) -> Run:
    """Read what `write_inputs` and `write_results` wrote.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a part of it is missing or unreadable.
    """
    folder = Path(folder)
    manifest = read_json(_require(folder, "run.json"))
    inputs = read_inputs(folder)
    u_mean, u_sd = read_point_data(folder / "mesh.vtu", "u_mean", "u_sd")
    warped = None if inputs.moving is None else load_image(_require(folder, "warped_mean.nii.gz"))
    if warped is not None and inputs.matching.scale is not None:
        warped = inputs.matching.scale(warped)
    metrics = read_json(folder / "metrics.json") if (folder / "metrics.json").exists() else None
    known = folder / "predicted.npz"
    predicted = Predicted(**load_arrays(known, "run anew, into another folder")) if known.exists() else None
    return Run(
        manifest=manifest,
        u_mean=u_mean,
        u_sd=u_sd,
        warped=warped,
        metrics=metrics,
        predicted=predicted,
        bodies=read_bodies(folder),
        **inputs._asdict(),
    )


def write_bodies(folder: str | Path, bodies: Sequence[Mapping[str, Any]]) -> None:
    """Write bodies.json of a run: simulated registrations on its mesh."""
    write_json(Path(folder) / BODIES, list(bodies))


def read_bodies(folder: str | Path) -> list[dict[str, Any]] | None:
    """Read what `write_bodies` wrote; None where nothing was, InputError where it is damaged."""
    path = Path(folder) / BODIES
    if not path.exists():
        return None
    bodies = read_json(path)
    whole = isinstance(bodies, list) and all(isinstance(body, dict) and body.keys() >= _BODY for body in bodies)
    if not whole:
        raise InputError(f"{path} holds no simulated bodies; remove it, and they are simulated anew")
    return bodies


def _require(folder: Path, name: str) -> Path:
    if not (folder / name).exists():
        raise InputError(f"{folder} holds no finished run: {name} is missing")
    return folder / name
