"""Run a configuration and write its run folder; this module connects all steps of a run.

The modules of the report are imported when the report is written, because their import would delay the start of a run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.ahead import ahead
from bayesreg.config import Config, load_config, load_stored_config, resolved_yaml
from bayesreg.inference.chains.beginning import (
    checkpoint_from_arrays,
    compile_programs,
    first_checkpoint,
    temper_target,
)
from bayesreg.inference.chains.checkpoint import Checkpoint, checkpoint_to_arrays
from bayesreg.inference.chains.progress import Showing
from bayesreg.inference.chains.run import Samples, sample
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.inference.draws.blocks import Block, Blocks
from bayesreg.inference.draws.inference_data import to_blocks
from bayesreg.io import checkpoints, store
from bayesreg.io.atomic import write_text
from bayesreg.io.records import Inputs
from bayesreg.io.run_folder import RunFolder
from bayesreg.messages import show_messages
from bayesreg.model.build import require_observations
from bayesreg.model.posterior import Posterior
from bayesreg.model.target import PosteriorTarget
from bayesreg.results.result import REPORT, Result, load_result
from bayesreg.types import AnyArray, InputError
from bayesreg.workflow.assembly import posterior_of, start_of, with_initial
from bayesreg.workflow.budget import BLOCK, block_length, max_seconds, require_memory
from bayesreg.workflow.fingerprint import fingerprint, require_same_observations
from bayesreg.workflow.finish import finish
from bayesreg.workflow.first_answer import write_first_answer
from bayesreg.workflow.interruption import ending_between_blocks
from bayesreg.workflow.preparation import (
    PROVENANCE,
    prepared_inputs,
    require_all_unseen,
    store_inputs,
    with_held_out,
    with_unsampled,
)
from bayesreg.workflow.reports import report
from bayesreg.workflow.sources import digests_of_sources, require_same_sources

_log = logging.getLogger(__name__)

# Sections of the configuration that do not change what is drawn.
MAY_CHANGE = ("stop", "results", "report", "evaluation")

CUT = (
    "The budget (stop.max_minutes) ended the search for the mode or the warm-up early: the chains of this run mix "
    "badly, and more draws help little. Begin the run anew, in another folder and with more time."
)

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
        searching = time.perf_counter()
        deadline = Deadline.after(max_seconds(config))
        with ahead(_compile, config, posterior):
            posterior = temper(config, inputs, posterior, deadline)
            provenance["independent_points"] = posterior.independent_points
            inputs = with_initial(inputs, config)
            spent = time.perf_counter() - searching
            provenance = with_unsampled(provenance, began + spent)
            reached = _first(config, inputs, posterior, provenance, folder, deadline, spent)
        if deadline.has_passed:
            provenance["appraisal"] = _with_warning(provenance.get("appraisal", {}), CUT)
        store_inputs(folder, inputs, provenance)
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
    posterior = posterior_of(config, inputs, observations, provenance.get("independent_points"))
    require_same_observations(folder.path, provenance, posterior, observations)
    # A pair that `simulate` stored is not tempered yet.
    deadline = Deadline.after(max_seconds(config))
    searching = time.perf_counter()
    posterior = temper(config, inputs, posterior, deadline)
    provenance["independent_points"] = posterior.independent_points
    if CUT in provenance.get("appraisal", {}).get("warnings", ()):
        _log.warning("%s", CUT)
    if finished:
        checkpoints.reopen(folder, to_blocks(posterior.target, load_result(folder.path).idata, BLOCK))
    inputs = with_initial(inputs._replace(config=resolved_yaml(config)), config)
    if stored_config.evaluation != config.evaluation:
        inputs = inputs._replace(observed=with_held_out(inputs.observed, config))
        require_all_unseen(inputs, observations)
    reached = _load_reached(config, inputs, posterior, provenance, folder, deadline, time.perf_counter() - searching)
    sampled = float(reached[0].seconds)
    began -= provenance["unsampled"] + sampled
    with folder.writing() as temporary_path:
        write_text(temporary_path("config.yaml"), inputs.config)
        store.write_observed(temporary_path, inputs.observed)
        store.write_json(temporary_path(PROVENANCE), with_unsampled(provenance, began + sampled))
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


def _with_warning(appraisal: Mapping[str, Any], sentence: str) -> dict[str, Any]:
    return {**appraisal, "warnings": [*appraisal.get("warnings", ()), sentence]}


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


def temper(config: Config, inputs: Inputs, posterior: Posterior, deadline: Deadline = NEVER) -> Posterior:
    """Temper the posterior by its numbers of independent points, unless it is tempered already."""
    if posterior.tempered:
        return posterior
    _log.info("first search for the mode, to count the independent points of the images there")
    start = start_of(config, inputs, posterior)
    target = temper_target(posterior.target, config.sampler.chains, config.seed, start, deadline)
    assert isinstance(target, PosteriorTarget)
    tempered = target.posterior
    for name, count in tempered.independent_points.items():
        _log.info(f"{name}: {count:,.0f} of {len(tempered.data.terms[name].positions):,} points are independent")
    return tempered


def _compile(config: Config, posterior: Posterior) -> None:
    options, length = config.sampler, _block(config, posterior)
    compile_programs(posterior.target, options.name, options.chains, length, options.thin, **options.settings)


def _block(config: Config, posterior: Posterior) -> int:
    return config.sampler.block or block_length(posterior)


def _first(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    provenance: dict[str, Any],
    folder: RunFolder,
    deadline: Deadline,
    seconds: float,
) -> Reached:
    """Make the state of the chains before their first step; InputError if a chain cannot start.

    When a search has led to the mode, the first answer is written. The `seconds` that were spent before count as
    sampling.
    """
    options, start = config.sampler, start_of(config, inputs, posterior)

    def answer(estimands: Mapping[str, AnyArray]) -> None:
        store_inputs(folder, inputs, provenance)
        write_first_answer(config, inputs, posterior, estimands, provenance.get("appraisal", {}), folder)
        _log.info("a first answer, about the mode, is in %s; sampling goes on", folder.path)

    checkpoint = first_checkpoint(
        posterior.target, options.name, options.chains, config.seed, start, deadline, answer, **options.settings
    )
    checkpoint = checkpoint._replace(seconds=checkpoint.seconds + seconds)
    return checkpoint, checkpoints.StoredBlocks(folder, 0)


def _load_reached(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    provenance: dict[str, Any],
    folder: RunFolder,
    deadline: Deadline,
    seconds: float,
) -> Reached:
    """Load the state of the chains that the interrupted run stored last."""
    state = checkpoints.load_state(folder)
    if state is None:
        return _first(config, inputs, posterior, provenance, folder, deadline, seconds)
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
        block=_block(config, posterior),
        stop=StopRule(config.stop.rhat, config.stop.ess, max_seconds(config)),
        progress=progress,
        resume=reached,
        on_block=keep,
        **options.settings,
    )
