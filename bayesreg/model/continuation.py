"""The way to a mode: problems of growing difficulty that lead to the posterior's own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from bayesreg.model.observations.observation import Eased
from bayesreg.model.program import Problem

Made = TypeVar("Made")

# Sd of the smoothing, mm, and factors on T_s and T_r of the problems that lead to the posterior's mode. Three stages
# instead of seven left single nodes of the paper's pair in wrong places, up to 15 mm off. A first stage of ten times
# the T_r folded a few tetrahedra of three in thirteen calibrated pairs, for good, with nodes about 30 mm off.
SMOOTHING = (
    (6.0, 30.0, 0.001), (4.0, 30.0, 0.02), (3.0, 20.0, 0.03), (2.0, 10.0, 0.05), (1.5, 5.0, 0.1), (1.0, 3.0, 0.3),
    (0.5, 1.0, 1.0),
)  # fmt: skip


def continuation(problem: Problem, observations: Mapping[str, object]) -> Iterator[Problem]:
    """Every problem, each to be solved for the displacements alone.

    Images smoothed by 6 mm and less and less, with a warmer similarity and a colder elastic prior: a displacement of
    many times its posterior standard deviation is found step by step. The last is the posterior's own. Where no node is
    sampled there is none, and without images, no easier one.
    """
    pairs = {name: pair for name, pair in observations.items() if isinstance(pair, Eased)}
    if not len(problem.body.slots):
        return
    if pairs:
        yield from _ahead([partial(_ease, problem, pairs, *stage) for stage in SMOOTHING])
    yield problem


def _ease(problem: Problem, pairs: Mapping[str, Eased], sd: float, similarity: float, elastic: float) -> Problem:
    """The problem with all images smoothed, and factors on T_s and T_r, or on the loads."""
    smooth = {name: pair.eased(problem.terms[name], sd) for name, pair in pairs.items()}
    easing = {**dict.fromkeys(pairs, similarity), "elastic": elastic}
    powers = {term: problem.terms[term].powers for term in easing if term in problem.terms}
    factors = {name: easing[term] ** power for term, scales in powers.items() for name, power in scales.items()}
    scales = {name: problem.blocks[name].times(factor) for name, factor in factors.items()}
    return problem._replace(blocks={**problem.blocks, **scales}, terms={**problem.terms, **smooth})


def _ahead(makers: Sequence[Callable[[], Made]]) -> Iterator[Made]:
    """Yield the result of each maker, and let the next one work in the background meanwhile."""
    pool = ThreadPoolExecutor(max_workers=1)
    try:
        coming = pool.submit(makers[0])
        for following in makers[1:]:
            made, coming = coming.result(), pool.submit(following)
            yield made
        yield coming.result()
    finally:
        # A caller that stops early does not wait for problems that are still being made.
        pool.shutdown(wait=False, cancel_futures=True)
