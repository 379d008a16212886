"""Run a configuration and write its run folder; this module connects all steps of a run.

The modules of the report are imported when the report is written, because their import would delay the start of a run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.config import Config, load_config, load_stored_config, resolved_yaml
from bayesreg.inference.chains.beginning import checkpoint_from_arrays
from bayesreg.inference.chains.checkpoint import Checkpoint, checkpoint_to_arrays
from bayesreg.inference.chains.progress import Showing
from bayesreg.inference.chains.run import Samples, sample
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.draws.blocks import Block, Blocks
from bayesreg.inference.draws.inference_data import to_blocks
from bayesreg.io import checkpoints, store
from bayesreg.io.atomic import write_text
from bayesreg.io.records import Inputs
from bayesreg.io.run_folder import RunFolder
from bayesreg.messages import show_messages
from bayesreg.model.build import require_observations
from bayesreg.model.posterior import Posterior
from bayesreg.results.result import REPORT, Result, load_result
from bayesreg.types import InputError
from bayesreg.workflow.assembly import posterior_of, with_initial
from bayesreg.workflow.beginning import CUT, begin, tempered_as_before
from bayesreg.workflow.budget import BLOCK, draws_per_block, max_seconds, require_memory
from bayesreg.workflow.fingerprint import fingerprint, require_same_observations
from bayesreg.workflow.finish import finish
from bayesreg.workflow.interruption import ending_between_blocks
from bayesreg.workflow.preparation import (
    PROVENANCE,
    prepared_inputs,
    require_all_unseen,
    with_held_out,
    with_unsampled,
)
from bayesreg.workflow.reports import report
from bayesreg.workflow.sources import digests_of_sources, require_same_sources

_log = logging.getLogger(__name__)

# Sections of the configuration that do not change what is drawn.
MAY_CHANGE = ("stop", "results", "report", "evaluation")

Reached = tuple[Checkpoint, Blocks]


def run(
    config: str | Path | Config,
    out: str | Path,
    resume: bool = False,
    progress: Showing = True,
    observations: Sequence[Any] = (),
) -> Result:
    """Run a configuration: prepare its inputs, sample the posterior and write the results.

    Parameters
    ----------
    config : path or Config
    out : path
        The run folder, new or empty; with `resume`, the folder of an interrupted or a finished run.
    resume : bool
        Continue after the last stored draws. If the sections `stop`, `results`, `report` and `evaluation` differ from
        those at the beginning of the run, the new sections apply. They can give a finished run more draws or other
        files, or compare it with landmarks that were found later.
    progress : bool or callable
        Whether to show messages and a progress bar; or a callable that makes the progress display, as in
        `bayesreg.sample`.
    observations : sequence
        Observations besides those of the configuration, such as `bayesreg.Landmarks`; see `bayesreg.build_posterior`.
        A run that began with such observations must be resumed with the same.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the configuration, a file or an observation is wrong, or the folder holds another run.
    """
    config = config if isinstance(config, Config) else load_config(config)
    checked_observations = require_observations(observations) if observations else []
    with show_messages() if progress is True else nullcontext():
        return _run(config, RunFolder(Path(out)), resume, progress, checked_observations)


def _run(config: Config, folder: RunFolder, resume: bool, progress: Showing, observations: list[Any]) -> Result:
    began = time.perf_counter()
    if resume and folder.stage is not None:
        with folder.locked():
            return _resume(config, folder, progress, observations, began)
    # A run that was interrupted before it stored its inputs begins again in the same folder.
    if not (resume and folder.status() is not None):
        folder.require_fresh()
    _log.info("reading the files and meshing")
    if config.has_images and not config.pairs_of_images:
        _log.info("the images are shown and not compared: observations does not name them ({kind: images})")
    # The digests precede the reading, so that a resumed run detects a file that changed during the reading.
    sources = digests_of_sources(config, MAY_CHANGE)
    inputs, provenance = prepared_inputs(config, observations)
    for line in provenance["appraisal"].get("notes", ()):
        _log.info("%s", line)
    for sentence in provenance["appraisal"].get("warnings", ()):
        _log.warning("%s", sentence)
    # The folder is written after all inputs are checked, and before the first step.
    posterior = posterior_of(config, inputs, observations)
    require_memory(config, posterior)
    provenance["observations"] = fingerprint(posterior, observations)
    provenance["sources"] = sources
    _log.info("%s", _describe_mesh(inputs))
    with folder.locked():
        if folder.stage is not None:
            raise InputError(f"another process has begun a run in {folder.path} meanwhile; name another folder")
        inputs = with_initial(inputs, config)
        posterior, checkpoint, provenance = begin(config, inputs, posterior, provenance, folder, began)
        reached = checkpoint, checkpoints.StoredBlocks(folder, 0)
        return _go_on(config, inputs, posterior, reached, provenance, folder, began, progress)


def _resume(config: Config, folder: RunFolder, progress: Showing, observations: list[Any], began: float) -> Result:
    stored_config = _resumed_config(folder, config)
    provenance = store.read_json(folder.file(PROVENANCE))
    require_same_sources(config, provenance.get("sources", {}), MAY_CHANGE, folder.path)
    finished = folder.stage == "finished"
    if finished and all(getattr(stored_config, name) == getattr(config, name) for name in MAY_CHANGE):
        _log.info("%s holds a finished run already; another budget (stop) would continue it", folder.path)
        if not folder.is_sound(REPORT):
            report(folder.path)
        return load_result(folder.path)
    inputs = store.read_inputs(folder)
    _log.info("%s", _describe_mesh(inputs))
    # A run without a state has not come to its chains. It begins again, so that its draws are those of a run that was
    # not interrupted.
    has_state = folder.is_listed(checkpoints.STATE)
    posterior = posterior_of(config, inputs, observations)
    if has_state:
        posterior = tempered_as_before(config, inputs, posterior, provenance)
    require_same_observations(folder.path, provenance, posterior, observations)
    if finished:
        checkpoints.reopen(folder, to_blocks(posterior.target, load_result(folder.path).idata, BLOCK))
    inputs = with_initial(inputs._replace(config=resolved_yaml(config)), config)
    if stored_config.evaluation != config.evaluation:
        inputs = inputs._replace(observed=with_held_out(inputs.observed, config))
        require_all_unseen(inputs, observations)
    began -= provenance["unsampled"]
    if has_state:
        if CUT in provenance.get("appraisal", {}).get("warnings", ()):
            _log.warning("%s", CUT)
        reached = _load_reached(config, posterior, folder)
        began -= float(reached[0].seconds)
    else:
        posterior, checkpoint, provenance = begin(config, inputs, posterior, provenance, folder, began)
        reached = checkpoint, checkpoints.StoredBlocks(folder, 0)
    with folder.writing() as temporary_path:
        write_text(temporary_path("config.yaml"), inputs.config)
        store.write_observed(temporary_path, inputs.observed)
        store.write_json(temporary_path(PROVENANCE), with_unsampled(provenance, began + float(reached[0].seconds)))
    return _go_on(config, inputs, posterior, reached, provenance, folder, began, progress)


def _go_on(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    reached: Reached,
    provenance: dict[str, Any],
    folder: RunFolder,
    began: float,
    progress: Showing,
) -> Result:
    """Sample from the current state of the chains, and write the results."""
    _save_state(folder, *reached)
    with ending_between_blocks() as require_no_signal:
        samples = _sample(config, posterior, reached, folder, progress, require_no_signal)
    _log.info("writing the results")
    result = finish(config, inputs, posterior, samples, provenance, folder, began)
    _log.info("%s", samples.reason)
    _warn(config, result)
    return result


def _warn(config: Config, result: Result) -> None:
    """Log the report's warning about a model that real images seldom fit."""
    from bayesreg.report.verdict import doubt_of_equilibrium

    doubt = doubt_of_equilibrium(result.run.manifest["model"], simulated=config.simulate is not None)
    if doubt is not None and config.pairs_of_images:
        _log.warning("%s", doubt)


def _resumed_config(folder: RunFolder, config: Config) -> Config:
    """Load the configuration of a begun run; InputError if it differs outside the sections `MAY_CHANGE`."""
    stored_config = load_stored_config(folder.file("config.yaml"))
    sections = {name: getattr(config, name) for name in MAY_CHANGE}
    if resolved_yaml(stored_config.model_copy(update=sections)) != resolved_yaml(config):
        raise InputError(
            f"{folder.path} holds a run of another configuration; resume it with its own "
            f"({folder.path / 'config.yaml'}), of which only the sections {', '.join(MAY_CHANGE)} may change, or name "
            "another folder"
        )
    return stored_config


def _describe_mesh(inputs: Inputs) -> str:
    mesh = inputs.mesh
    return f"mesh of {len(mesh.points)} nodes ({len(mesh.boundary)} on the boundary) and {len(mesh.cells)} elements"


def _load_reached(config: Config, posterior: Posterior, folder: RunFolder) -> Reached:
    """Load the state of the chains that the interrupted run stored last."""
    state = checkpoints.load_state(folder)
    blocks = checkpoints.StoredBlocks(folder, int(state.pop("blocks")))
    options = config.sampler
    return checkpoint_from_arrays(state, posterior.target, options.name, options.chains, **options.settings), blocks


def _save_state(folder: RunFolder, checkpoint: Checkpoint, blocks: Blocks) -> None:
    checkpoints.save_state(folder, {"blocks": np.array(len(blocks)), **checkpoint_to_arrays(checkpoint)})


def _sample(
    config: Config,
    posterior: Posterior,
    reached: Reached,
    folder: RunFolder,
    progress: Showing,
    after_block: Callable[[], None] = lambda: None,
) -> Samples:
    def keep(_index: int, _block: Block, checkpoint: Checkpoint) -> None:
        _save_state(folder, checkpoint, reached[1])
        after_block()

    options = config.sampler
    return sample(
        posterior,
        options.name,
        options.chains,
        config.stop.max_steps // options.thin,
        config.seed,
        thin=options.thin,
        block=draws_per_block(config, posterior),
        stop=StopRule(config.stop.rhat, config.stop.ess, max_seconds(config)),
        progress=progress,
        resume=reached,
        on_block=keep,
        **options.settings,
    )
