"""A sequence of problems of growing difficulty, which leads to the mode of the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from bayesreg.model.observations.observation import Smoothable
from bayesreg.model.program import Problem

Made = TypeVar("Made")

# Sd of the smoothing, mm, and factors on T_s and T_r of the problems that lead to the posterior's mode. With three
# stages instead of seven, single nodes of the paper's pair ended in wrong places, up to 15 mm off. A first stage with
# ten times the T_r folded a few tetrahedra permanently in three of thirteen calibrated pairs, with nodes about 30 mm
# off.
SMOOTHING = (
    (6.0, 30.0, 0.001), (4.0, 30.0, 0.02), (3.0, 20.0, 0.03), (2.0, 10.0, 0.05), (1.5, 5.0, 0.1), (1.0, 3.0, 0.3),
    (0.5, 1.0, 1.0),
)  # fmt: skip


def continuation(problem: Problem, observations: Mapping[str, object]) -> Iterator[Problem]:
    """Yield every problem of the sequence; the search solves each for the displacements only.

    The first problems have images smoothed by up to 6 mm, a higher T_s and a lower T_r. The search can then find
    displacements of many posterior standard deviations step by step. The last problem is the posterior's own. The
    sequence is empty if no node is sampled, and has no easier problem if there are no images.
    """
    pairs = {name: pair for name, pair in observations.items() if isinstance(pair, Smoothable)}
    if not len(problem.body.sampled_index):
        return
    if pairs:
        yield from _prefetch([partial(_ease, problem, pairs, *stage) for stage in SMOOTHING])
    yield problem


def _ease(problem: Problem, pairs: Mapping[str, Smoothable], sd: float, similarity: float, elastic: float) -> Problem:
    """Return the problem with all images smoothed, and with factors on T_s and T_r, or on the loads."""
    smooth = {name: pair.smoothed_term(problem.terms[name], sd) for name, pair in pairs.items()}
    easing = {**dict.fromkeys(pairs, similarity), "elastic": elastic}
    powers = {term: problem.terms[term].powers for term in easing if term in problem.terms}
    factors = {name: easing[term] ** power for term, scales in powers.items() for name, power in scales.items()}
    scales = {name: problem.blocks[name].multiplied_by(factor) for name, factor in factors.items()}
    return problem._replace(blocks={**problem.blocks, **scales}, terms={**problem.terms, **smooth})


def _prefetch(makers: Sequence[Callable[[], Made]]) -> Iterator[Made]:
    """Yield the result of each maker, while a background thread computes the next one."""
    pool = ThreadPoolExecutor(max_workers=1)
    try:
        future = pool.submit(makers[0])
        for maker in makers[1:]:
            result, future = future.result(), pool.submit(maker)
            yield result
        yield future.result()
    finally:
        # A caller that stops early must not wait for problems that are still being made.
        pool.shutdown(wait=False, cancel_futures=True)
