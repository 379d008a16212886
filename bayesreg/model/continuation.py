"""The way to a mode: problems of growing difficulty that lead to the posterior's own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from bayesreg.image import Image, Interpolation, Interpolator
from bayesreg.model.program import RegistrationData

Made = TypeVar("Made")

# Sd of the smoothing, mm, and factors on T_s and T_r of the problems that lead to the posterior's mode. Three stages
# instead of seven left single nodes of the paper's pair in wrong places, up to 15 mm off. A first stage of ten times
# the T_r folded a few tetrahedra of three in thirteen calibrated pairs, for good, with nodes about 30 mm off.
SMOOTHING = (
    (6.0, 30.0, 0.001), (4.0, 30.0, 0.02), (3.0, 20.0, 0.03), (2.0, 10.0, 0.05), (1.5, 5.0, 0.1), (1.0, 3.0, 0.3),
    (0.5, 1.0, 1.0),
)  # fmt: skip


def continuation(
    data: RegistrationData, fixed: Image, moving: Image, interpolation: Interpolation
) -> Iterator[RegistrationData]:
    """Data of every problem, each to be solved for the displacements alone.

    Images smoothed by 6 mm and less and less, with a warmer similarity and a colder elastic prior: a displacement of
    many times its posterior standard deviation is found step by step. The last is the posterior's own. Where no node is
    sampled there is none.
    """
    if len(data.slots):
        yield from _ahead([partial(_eased, data, fixed, moving, interpolation, *stage) for stage in SMOOTHING])
        yield data


def _eased(
    data: RegistrationData,
    fixed: Image,
    moving: Image,
    interpolation: Interpolation,
    sigma: float,
    similarity: float,
    elastic: float,
) -> RegistrationData:
    """The problem with both images smoothed, and factors on T_s and T_r."""
    # SciPy's filters let other threads run.
    with ThreadPoolExecutor() as pool:
        smooth_fixed, smooth_moving = pool.map(partial(_smoothed, sigma, interpolation), (fixed, moving))
    return data._replace(
        moving=smooth_moving,
        fixed_values=smooth_fixed(data.positions),
        t_similarity=similarity * data.t_similarity,
        t_elastic=elastic * data.t_elastic,
    )


def _smoothed(sigma: float, interpolation: Interpolation, image: Image) -> Interpolator:
    return image.smoothed(sigma).interpolator(interpolation)


def _ahead(makers: Sequence[Callable[[], Made]]) -> Iterator[Made]:
    """What each makes, the next one in the background while one is being used."""
    pool = ThreadPoolExecutor(max_workers=1)
    try:
        coming = pool.submit(makers[0])
        for following in makers[1:]:
            made, coming = coming.result(), pool.submit(following)
            yield made
        yield coming.result()
    finally:
        # Who has had enough does not wait for what is under way.
        pool.shutdown(wait=False, cancel_futures=True)
