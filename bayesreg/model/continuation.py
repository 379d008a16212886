"""The way to a mode: problems of growing difficulty that end with the posterior's own."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from bayesreg.image import Image, Interpolation, Interpolator
from bayesreg.model.program import RegistrationData

# Sd of the smoothing, mm, and factors on T_s and T_r of the problems that lead to the posterior's mode. Three stages
# instead of seven left single nodes of the paper's pair in wrong places, up to 15 mm off. A first stage of ten times
# the T_r folded a few tetrahedra of three in thirteen calibrated pairs, for good, with nodes about 30 mm off.
SMOOTHING = (
    (6.0, 30.0, 0.001), (4.0, 30.0, 0.02), (3.0, 20.0, 0.03), (2.0, 10.0, 0.05), (1.5, 5.0, 0.1), (1.0, 3.0, 0.3),
    (0.5, 1.0, 1.0),
)  # fmt: skip


def continuation(
    data: RegistrationData, fixed: Image, moving: Image, interpolation: Interpolation
) -> Iterator[tuple[RegistrationData, bool]]:
    """Data of every problem, and whether it moves λ, μ and the temperatures, too.

    Images smoothed by 6 mm and less and less, with a warmer similarity and a colder elastic prior: a displacement of
    many times its posterior standard deviation is found step by step. The last two are the posterior itself, first in
    the displacements alone. Where no node is sampled, the last is all there is.
    """
    if len(data.slots):
        for sigma, similarity, elastic in SMOOTHING:
            # SciPy's filters let other threads run.
            with ThreadPoolExecutor() as pool:
                smooth_fixed, smooth_moving = pool.map(partial(_smoothed, sigma, interpolation), (fixed, moving))
            yield (
                data._replace(
                    moving=smooth_moving,
                    fixed_values=smooth_fixed(data.positions),
                    t_similarity=similarity * data.t_similarity,
                    t_elastic=elastic * data.t_elastic,
                ),
                False,
            )
        yield data, False
    yield data, True


def _smoothed(sigma: float, interpolation: Interpolation, image: Image) -> Interpolator:
    return image.smoothed(sigma).interpolator(interpolation)
