"""The way to a mode: problems of growing difficulty that lead to the posterior's own."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

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
) -> Iterator[RegistrationData]:
    """Data of every problem, each to be solved for the displacements alone.

    Images smoothed by 6 mm and less and less, with a warmer similarity and a colder elastic prior: a displacement of
    many times its posterior standard deviation is found step by step. The last is the posterior's own. Where no node is
    sampled there is none.
    """
    if len(data.slots):
        # SciPy's filters let other threads run: images are smoothed while the problems before them are being solved.
        with ThreadPoolExecutor(max_workers=2) as pool:
            smoothed = [
                [pool.submit(_smoothed, sigma, interpolation, image) for image in (fixed, moving)]
                for sigma, _, _ in SMOOTHING
            ]
            for images, (_, similarity, elastic) in zip(smoothed, SMOOTHING, strict=True):
                smooth_fixed, smooth_moving = (image.result() for image in images)
                yield data._replace(
                    moving=smooth_moving,
                    fixed_values=smooth_fixed(data.positions),
                    t_similarity=similarity * data.t_similarity,
                    t_elastic=elastic * data.t_elastic,
                )
        yield data


def _smoothed(sigma: float, interpolation: Interpolation, image: Image) -> Interpolator:
    return image.smoothed(sigma).interpolator(interpolation)
