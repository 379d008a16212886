"""The check that a resumed run has the observations from Python with which it began."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.model.posterior import Posterior
from bayesreg.types import InputError


def fingerprint(posterior: Posterior, observations: list[Any]) -> dict[str, float | None]:
    """Compute the log likelihood of each observation at one displacement of up to 1 mm; None if it is not finite."""
    if not observations:
        return {}
    rest = posterior.reference()
    displacement = np.sin(np.arange(rest["u_boundary"].size)).reshape(rest["u_boundary"].shape)
    logs = posterior.energies(rest | {"u_boundary": displacement})
    log_likelihoods = {observation.name: float(logs[observation.name]) for observation in observations}
    return {name: log if np.isfinite(log) else None for name, log in log_likelihoods.items()}


def require_same_observations(
    out: Path, provenance: dict[str, Any], posterior: Posterior, observations: list[Any]
) -> None:
    """Raise InputError if a run is resumed with other observations than it began with."""
    begun, now = provenance.get("observations", {}), fingerprint(posterior, observations)
    advice = "give the same to bayesreg.run(..., observations=[...])"
    if list(begun) != list(now):
        raise InputError(
            f"the run in {out} began with the observations {list(begun) or 'none'} besides those of its configuration, "
            f"and is resumed with {list(now) or 'none'}: {advice}"
        )
    for name, log in now.items():
        then = begun[name]
        if (log is None) != (then is None) or (log is not None and not np.isclose(log, then, rtol=1e-6)):
            raise InputError(
                f"the run in {out} began with another observation {name!r} than it is resumed with: their logs at one "
                f"displacement are {then} and {log}; {advice}"
            )
