"""The beginning of a run: the search for the mode, the first answer, and the chains before their first draw."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from bayesreg.ahead import ahead
from bayesreg.config import Config
from bayesreg.inference.chains.beginning import compile_programs, first_checkpoint, temper_target
from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.io.records import Inputs
from bayesreg.io.run_folder import RunFolder
from bayesreg.model.posterior import Posterior
from bayesreg.model.target import PosteriorTarget
from bayesreg.types import AnyArray, InputError
from bayesreg.workflow.assembly import start_of
from bayesreg.workflow.budget import draws_per_block, max_seconds
from bayesreg.workflow.first_answer import write_first_answer
from bayesreg.workflow.preparation import store_inputs, with_unsampled

_log = logging.getLogger(__name__)

CUT = (
    "The budget (stop.max_minutes) ended the search for the mode or the warm-up early: the draws of this run are not "
    "to be relied on, and more of them help little. Begin the run anew, in another folder and with more time."
)


class Begun(NamedTuple):
    """A run before its first draw.

    Attributes
    ----------
    posterior : Posterior
        Tempered by its numbers of independent points.
    checkpoint : Checkpoint
    provenance : dict
    """

    posterior: Posterior
    checkpoint: Checkpoint
    provenance: dict[str, Any]


def begin(
    config: Config, inputs: Inputs, posterior: Posterior, provenance: dict[str, Any], folder: RunFolder, began: float
) -> Begun:
    """Search for the mode and warm the chains up; store the inputs.

    When a search has led near the mode, the inputs and the first answer are stored. A search or a warm-up that fails
    leaves no run in the folder.

    Parameters
    ----------
    config : Config
    inputs : Inputs
    posterior : Posterior
    provenance : dict
    folder : RunFolder
    began : float
        `time.perf_counter()` at the beginning of the run, minus the seconds that earlier processes spent on it.

    Raises
    ------
    InputError
        If a chain cannot start.
    """
    searching = time.perf_counter()
    deadline = Deadline.after(max_seconds(config))
    if posterior.target.prepare_marginal is not None:
        # The programs have the shapes of the Gaussian about the mode. The next call returns at once.
        posterior = temper(config, inputs, posterior)
    with ahead(_programs(config, posterior)):
        posterior = temper(config, inputs, posterior, deadline)
        provenance = provenance | {"independent_points": posterior.independent_points}
        provenance = with_unsampled(provenance, began + time.perf_counter() - searching)

        def answer(estimands: Mapping[str, AnyArray]) -> None:
            # It costs less than the searches. The warm-up needs the rest of a budget of which they took more than half.
            if deadline.remaining < time.perf_counter() - searching:
                return
            store_inputs(folder, inputs, provenance)
            write_first_answer(config, inputs, posterior, estimands, provenance["appraisal"], folder)
            _log.info("a first answer, about the mode, is in %s; the run goes on", folder.path)

        options, start = config.sampler, start_of(config, inputs, posterior)
        try:
            checkpoint = first_checkpoint(
                posterior.target, options.name, options.chains, config.seed, start, deadline, answer, **options.settings
            )
        except InputError:
            folder.clear()
            raise
        # A run that begins again may have been cut before.
        warnings = [warning for warning in provenance["appraisal"].get("warnings", ()) if warning != CUT]
        warnings += [CUT] if deadline.has_passed else []
        provenance["appraisal"] = provenance["appraisal"] | {"warnings": warnings}
    store_inputs(folder, inputs, provenance)
    return Begun(posterior, checkpoint._replace(seconds=np.array(time.perf_counter() - searching)), provenance)


def temper(config: Config, inputs: Inputs, posterior: Posterior, deadline: Deadline = NEVER) -> Posterior:
    """Temper the posterior by its numbers of independent points, unless it is tempered already."""
    if posterior.tempered:
        return posterior
    _log.info("first search for the mode, to count the independent points there")
    if (marginalisation := posterior.target.prepare_marginal) is not None:
        tempered = posterior.tempered_by(*marginalisation.count_independent_points(posterior.observations))
    else:
        start = start_of(config, inputs, posterior)
        target = temper_target(posterior.target, config.sampler.chains, config.seed, start, deadline)
        assert isinstance(target, PosteriorTarget)
        tempered = target.posterior
    for name, count in tempered.independent_points.items():
        _log.info(f"{name}: {count:,.0f} of {len(tempered.data.terms[name].observed()):,} points are independent")
    return tempered


def tempered_as_before(
    config: Config, inputs: Inputs, posterior: Posterior, provenance: Mapping[str, Any]
) -> Posterior:
    """Return the posterior as it was tempered when its run began.

    A surface needs the mode again, from which the same search counts the same points.
    """
    if posterior.target.prepare_marginal is not None:
        return temper(config, inputs, posterior)
    counts = provenance.get("independent_points")
    return posterior.with_independent_points(counts) if counts else posterior


def _programs(config: Config, posterior: Posterior) -> Iterator[None]:
    options, length = config.sampler, draws_per_block(config, posterior)
    return compile_programs(posterior.target, options.name, options.chains, length, options.thin, **options.settings)
