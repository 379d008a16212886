"""Write the results of a run after its last draw: the files of its folder, and the report."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import xarray as xr

from bayesreg.config import Config
from bayesreg.fem.deformation import Deformer
from bayesreg.image import Image
from bayesreg.inference.chains.run import Samples
from bayesreg.inference.draws.inference_data import append_groups, dataset, open_posterior, save_posterior
from bayesreg.io import checkpoints, store
from bayesreg.io.point_formats import PointPairs
from bayesreg.io.records import Inputs, Predicted, Run
from bayesreg.io.run_folder import RunFolder
from bayesreg.io.volumes import save_image
from bayesreg.model.observations.observation import MAPS, Doubtful, Mapped, Noted
from bayesreg.model.posterior import Posterior
from bayesreg.model.submesh import unresolved_in
from bayesreg.model.warp import warp_image
from bayesreg.pose import Pose
from bayesreg.report.metrics import compute_metrics
from bayesreg.results.bids import FOLDER, write_bids
from bayesreg.results.displacement_fields import ENSEMBLE, moments_on, write_transforms
from bayesreg.results.nodal_draws import POINT_DRAWS, nodal_draws
from bayesreg.results.result import POSTERIOR, REPORT, Result
from bayesreg.results.transform import Transform
from bayesreg.workflow.evaluation import NAME, evaluate_landmarks
from bayesreg.workflow.manifest import manifest
from bayesreg.workflow.prediction import mean_values, predict, with_unresolved
from bayesreg.workflow.predictive_groups import predictive_groups

_log = logging.getLogger(__name__)


def finish(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    samples: Samples,
    provenance: dict[str, Any],
    folder: RunFolder,
    began: float,
) -> Result:
    """Write all results of the draws, and the report, into the folder of the run."""
    from bayesreg.report.html import write_report

    idata = _store_draws(posterior, samples, folder, config.seed)
    draws, judged = dataset(idata, "posterior"), samples.convergence
    grid, pose = inputs.fixed or inputs.tissue, inputs.matching.pose
    metrics = None
    if inputs.truth is not None:
        metrics = compute_metrics(inputs.mesh, samples.u_mean, inputs.truth, draws)
    mean, deformer = mean_values(posterior, draws, samples.u_mean), Deformer(inputs.mesh)
    predicted = predict(posterior, draws, mean, samples.u_mean, samples.u_sd, config.report.places, config.seed, pose)
    provenance = _with_findings(provenance, posterior, predicted)

    def transform(most: int) -> Transform:
        u = nodal_draws(config.model, inputs, draws, most)
        unresolved = unresolved_in(posterior.data.body, mean, u)
        return Transform(deformer, pose, samples.u_mean, u, unresolved, seed=config.seed)

    sampled_transform = transform(POINT_DRAWS)
    predicted = with_unresolved(predicted, sampled_transform)
    if config.evaluation is not None:
        held_out = evaluate_landmarks(
            PointPairs.of_arrays(inputs.observed[NAME]), sampled_transform, config.evaluation.sd
        )
        predicted = predicted._replace(**held_out)
    moments = moments_on(sampled_transform, grid)
    finished = Run(
        manifest=manifest(config, inputs, posterior, samples, sampled_transform.draws, mean, judged, provenance, began)
        | {"displacement_sd": moments.rms_sd},
        u_mean=samples.u_mean,
        u_sd=samples.u_sd,
        warped=warp_moving(inputs, moments.mean),
        metrics=metrics,
        predicted=predicted,
        **inputs._asdict(),
    )
    # The run may have finished before, with other files in these folders.
    for subfolder in (ENSEMBLE, FOLDER, MAPS):
        folder.drop(subfolder)
    with folder.writing() as place:
        write_transforms(place, transform(config.results.draws), grid)
        store.write_results(place, finished, *moments.rounded)
        for name, image in _maps(posterior, predicted, pose).items():
            save_image(image, place(name))
    with folder.writing("finished") as place:
        if config.results.bids is not None:
            write_bids(folder.path, config.results.bids, place)
        write_report(finished, idata, *judged, place(REPORT))
    checkpoints.close(folder)
    return Result(folder.path, finished)


def _with_findings(provenance: dict[str, Any], posterior: Posterior, predicted: Predicted) -> dict[str, Any]:
    """Log what observations doubt and what they note, and add it to the appraisal."""
    warnings: list[str] = []
    notes: list[str] = []
    for name, observation in posterior.observations.items():
        summary = predicted.of_observation(name)
        if isinstance(observation, Doubtful):
            warnings += observation.doubts(summary)
        if isinstance(observation, Noted):
            notes += observation.notes(summary)
    for level, sentences in ((logging.WARNING, warnings), (logging.INFO, notes)):
        for sentence in sentences:
            _log.log(level, "%s", sentence)
    appraisal = provenance.get("appraisal", {})
    added = {"warnings": warnings, "notes": notes}
    return provenance | {"appraisal": appraisal | {key: [*appraisal.get(key, ()), *added[key]] for key in added}}


def _maps(posterior: Posterior, predicted: Predicted, pose: Pose) -> dict[str, Image]:
    """Collect the maps of the observations by the names of their files, each in the world of its image's file."""
    images: dict[str, Image] = {}
    for name, observation in posterior.observations.items():
        if isinstance(observation, Mapped):
            maps = observation.maps(predicted.of_observation(name))
            images |= maps.of_fixed | {file: pose.inverse.aligned(image) for file, image in maps.of_moving.items()}
    return images


def _store_draws(posterior: Posterior, samples: Samples, folder: RunFolder, seed: int) -> Any:
    """Write posterior.nc with the draws and ArviZ's groups of the observations, and open it."""
    with folder.writing() as place:
        path = place(POSTERIOR)
        save_posterior(posterior.target, samples.blocks, path)
        # Groups cannot be appended to an open file.
        with xr.open_dataset(path, group="posterior") as draws:
            groups = predictive_groups(posterior, draws, seed)
        append_groups(path, groups)
    return open_posterior(folder.path / POSTERIOR)


def warp_moving(inputs: Inputs, mean_field: np.ndarray) -> Image | None:
    """Resample the moving image on the fixed grid by the mean displacement and the pose."""
    if inputs.moving is None or inputs.fixed is None:
        return None
    # The stored moving image is aligned; its own world is that of its file.
    return warp_image(inputs.matching.pose.inverse.aligned(inputs.moving), mean_field, inputs.fixed)
