"""The registry of samplers, all through BlackJAX: name to (target, settings…) → `Sampler`.

The paper's kernel moves in the constrained space of the estimands; the others in the coordinates in which Laplace's
approximation is N(0, I) (`bayesreg.inference.whitened`), most of them reflected by the skull
(`bayesreg.inference.reflection`).
"""

from __future__ import annotations

from collections.abc import Callable

from bayesreg.inference.approximations import laplace_sampler, pathfinder
from bayesreg.inference.hamiltonian import hmc, mclmc, nuts
from bayesreg.inference.kernel import Sampler
from bayesreg.inference.local import barker, mala, pcn, rwmh_adaptive
from bayesreg.inference.random_walk import rwmh
from bayesreg.inference.tempering import smc

SAMPLERS: dict[str, Callable[..., Sampler]] = {
    "rwmh": rwmh,
    "hmc": hmc,
    "nuts": nuts,
    "mclmc": mclmc,
    "mala": mala,
    "barker": barker,
    "rwmh_adaptive": rwmh_adaptive,
    "pcn": pcn,
    "smc": smc,
    "laplace": laplace_sampler,
    "pathfinder": pathfinder,
}
