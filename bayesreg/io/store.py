"""Writers and readers of a run's folder; readers verify that files have the content that was written."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayesreg.io.atomic import load_arrays, read_json, save_arrays, write_json, write_text
from bayesreg.io.displacements import read_point_data
from bayesreg.io.fields import save_displacement
from bayesreg.io.intensities import in_levels, save_in_levels
from bayesreg.io.meshing import load_mesh, save_mesh
from bayesreg.io.records import Channel, Inputs, Matching, Predicted, Run, Truth
from bayesreg.io.run_folder import ANEW, Place, RunFolder
from bayesreg.io.spaces import LPS
from bayesreg.io.volumes import load_image, save_image


def write_inputs(place: Place, inputs: Inputs) -> None:
    """Write config.yaml, mesh.vtu and the files in inputs/."""
    labels = {name: getattr(inputs, name) for name in ("tissue", "skull", "fixed_ignore", "moving_ignore")}
    saved: list[Future] = []
    images = {"fixed": inputs.fixed, "moving": inputs.moving}
    for name, channel in inputs.channels.items():
        images |= {f"channel-{name}-fixed": channel.fixed, f"channel-{name}-moving": channel.moving}
    # Compression releases the interpreter's lock, so that threads run in parallel.
    with ThreadPoolExecutor() as pool:
        for save, named_images in ((save_image, labels), (save_in_levels, images)):
            for name, image in named_images.items():
                if image is not None:
                    saved.append(pool.submit(save, image, place(f"inputs/{name}.nii.gz")))
    for future in saved:
        future.result()
    if inputs.truth is not None:
        truth_arrays = {key: value for key, value in inputs.truth._asdict().items() if value is not None}
        save_arrays(place("inputs/truth.npz"), truth_arrays)
    if inputs.boundary is not None:
        save_arrays(place("inputs/boundary.npz"), {"u_boundary": inputs.boundary})
    write_observed(place, inputs.observed)
    channels = {name: channel.one_contrast for name, channel in inputs.channels.items()}
    write_json(place("inputs/matching.json"), inputs.matching.as_json() | {"channels": channels})
    save_mesh(inputs.mesh, place("inputs/mesh.vtu"))
    # Users look for mesh.vtu here; later the results are added to this file.
    save_mesh(inputs.mesh, place("mesh.vtu"))
    write_text(place("config.yaml"), inputs.config)


def write_observed(place: Place, observed: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write inputs/observed.npz, with arrays named "<observation>/<array>", if there are any arrays."""
    named = {f"{name}/{key}": value for name, arrays in observed.items() for key, value in arrays.items()}
    if named:
        save_arrays(place("inputs/observed.npz"), named)


def read_inputs(folder: RunFolder) -> Inputs:
    """Read the files of `write_inputs`; raise InputError if a file is missing or damaged."""
    config = folder.file("config.yaml").read_text(encoding="utf-8")
    mesh = load_mesh(folder.file("inputs/mesh.vtu"))
    tissue = load_image(folder.file("inputs/tissue.nii.gz"))
    skull, fixed_ignore, moving_ignore = (
        None if (path := _file(folder, f"inputs/{name}.nii.gz")) is None else load_image(path)
        for name in ("skull", "fixed_ignore", "moving_ignore")
    )
    fixed, moving = (
        None if (path := _file(folder, f"inputs/{name}.nii.gz")) is None else in_levels(load_image(path))
        for name in ("fixed", "moving")
    )
    truth_arrays, boundary_arrays, observed_arrays = (
        None if (path := _file(folder, f"inputs/{name}.npz")) is None else load_arrays(path, ANEW)
        for name in ("truth", "boundary", "observed")
    )
    truth = None if truth_arrays is None else Truth(**truth_arrays)
    boundary = None if boundary_arrays is None else boundary_arrays["u_boundary"]
    observed = {} if observed_arrays is None else _observed_of(observed_arrays)
    known_of_images = read_json(folder.file("inputs/matching.json"))
    channels = {name: _channel(folder, name, alike) for name, alike in known_of_images["channels"].items()}
    return Inputs(
        config, mesh, fixed, moving, tissue, skull, truth, boundary, observed, Matching.of_json(known_of_images),
        fixed_ignore, moving_ignore, channels,
    )  # fmt: skip


def _channel(folder: RunFolder, name: str, one_contrast: bool) -> Channel:
    paths = (folder.file(f"inputs/channel-{name}-{which}.nii.gz") for which in ("fixed", "moving"))
    fixed, moving = (in_levels(load_image(path)) for path in paths)
    return Channel(fixed, moving, one_contrast)


def _observed_of(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    observed: dict[str, dict[str, np.ndarray]] = {}
    for key, value in arrays.items():
        name, field = key.split("/")
        observed.setdefault(name, {})[field] = value
    return observed


def write_results(
    place: Place,
    run: Run,
    displacement_mean: Float[np.ndarray, "X Y Z 3"],
    displacement_sd: Float[np.ndarray, "X Y Z 3"],
) -> None:
    """Write the result files of a finished run; the arguments are those of `write_displacement`."""
    write_displacement(place, run, displacement_mean, displacement_sd)
    if run.metrics is not None:
        write_json(place("metrics.json"), run.metrics)
    if run.predicted is not None:
        save_arrays(place("predicted.npz"), run.predicted.as_arrays())
    write_json(place("run.json"), run.manifest)


def write_displacement(
    place: Place,
    run: Run,
    displacement_mean: Float[np.ndarray, "X Y Z 3"],
    displacement_sd: Float[np.ndarray, "X Y Z 3"],
) -> None:
    """Write the displacement of a run on its mesh and on its grid, and the warped image.

    Parameters
    ----------
    place : callable
        The callable from `RunFolder.writing`.
    run : Run
    displacement_mean, displacement_sd : (X, Y, Z, 3) arrays
        Posterior mean and standard deviation of u on the grid of `run.background`, world RAS, mm. The mean is written
        as a resampling transform (LPS vectors, intent 1007), the standard deviation as positive vectors.
    """
    by_cell = {} if run.predicted is None else run.predicted.by_cell
    save_mesh(run.mesh, place("mesh.vtu"), {"u_mean": run.u_mean, "u_sd": run.u_sd}, by_cell)
    if run.warped is not None:
        save_in_levels(run.warped, place("warped_mean.nii.gz"), run.matching.scale)
    affine = run.background.affine
    save_displacement(place("displacement_mean.nii.gz"), displacement_mean, affine)
    # The writer converts vectors to LPS. A standard deviation is no vector and must stay positive.
    unsigned = np.asarray(displacement_sd) * LPS
    save_displacement(place("displacement_sd.nii.gz"), unsigned, affine)


def read_run(folder: RunFolder) -> Run:
    """Read the files of `write_inputs` and `write_results`.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a file of it is missing or damaged.
    """
    folder.require_finished()
    manifest = read_json(folder.file("run.json"))
    inputs = read_inputs(folder)
    u_mean, u_sd = read_point_data(folder.file("mesh.vtu"), "u_mean", "u_sd")
    warped = None if inputs.moving is None else load_image(folder.file("warped_mean.nii.gz"))
    if warped is not None and inputs.matching.scale is not None:
        warped = inputs.matching.scale(warped)
    metrics = None if (path := _file(folder, "metrics.json")) is None else read_json(path)
    predicted = (
        None if (path := _file(folder, "predicted.npz")) is None else Predicted.of_arrays(load_arrays(path, ANEW))
    )
    return Run(
        manifest=manifest,
        u_mean=u_mean,
        u_sd=u_sd,
        warped=warped,
        metrics=metrics,
        predicted=predicted,
        **inputs._asdict(),
    )


def _file(folder: RunFolder, name: str) -> Path | None:
    """Return the path of an optional file of a run, or None if the run has no such file."""
    return folder.file(name) if folder.is_listed(name) else None
