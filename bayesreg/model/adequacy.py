"""The fit of every observation to the posterior."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesreg.model.blocks import Values
from bayesreg.model.observations.registry import kinds
from bayesreg.model.observations.section import ObservationSection
from bayesreg.model.posterior import Posterior
from bayesreg.model.state import State, state_of
from bayesreg.model.term import Standardised
from bayesreg.settings import Section


def describe_observations(posterior: Posterior, values: Values) -> dict[str, dict[str, Any]]:
    """Describe how well every observation fits at some values.

    Returns
    -------
    dict
        A dict for each observation, by its name. It has the "kind" of the observation, the "title" of the kind, its
        "options" if it has any, and the "log" of its term. If the term provides its residuals, it has their number,
        "values", and their root mean square in units of their sd, "residual_rms". It also has the entries
        that the observation's method `describe` returns.
    """
    filled = posterior.fill(values)
    state = state_of(posterior.data.body, posterior.data.blocks, filled)
    return {
        name: _describe(observation, posterior.data.terms[name], state)
        for name, observation in posterior.observations.items()
    }


def _describe(observation: Any, term: Any, state: State) -> dict[str, Any]:
    kind = getattr(observation, "kind", "own")
    title = kinds().get(kind, ObservationSection).title
    description: dict[str, Any] = {"kind": kind, "title": title, "log": float(term.log(state))}
    if isinstance(options := getattr(observation, "options", None), Section):
        description["options"] = options.model_dump(mode="json")
    # An observation from outside the package may provide nothing but its log.
    standardised = next((candidate for candidate in (term, observation) if isinstance(candidate, Standardised)), None)
    if standardised is not None:
        z = np.asarray(standardised.standardised_residual(state))
        description |= {"values": z.size, "residual_rms": float(np.sqrt(np.mean(z**2)))}
    return description | (observation.describe(term, state) if hasattr(observation, "describe") else {})
