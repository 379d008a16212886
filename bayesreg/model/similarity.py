"""Similarities of two images at quadrature points; the likelihood is exp(−E_s / T_s) / Z_s, eq. (11)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from jaxtyping import Float

from bayesreg.model.local_correlation import LocalCorrelation
from bayesreg.model.mutual_information import MutualInformation
from bayesreg.model.options import ModelConfig
from bayesreg.model.pointwise import POINTWISE, Intensities, Pointwise, SumOfSquaredDifferences, ValueCurvature
from bayesreg.types import AnyArray, Scalar


class Similarity(Protocol):
    """How the likelihood compares f and the warped m (a pytree).

    `temperature` stands for T_s, mm³ times squared intensity.
    """

    @classmethod
    def on(cls, model: ModelConfig, positions: Float[np.ndarray, "points 3"], rest: Intensities) -> Similarity:
        """The similarity at these points, mm, of images with these intensities at rest, with the options' settings."""

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """E_s, mm³ times squared intensity."""

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """−log Z_s, with which exp(−E_s / T_s) is a density of the residuals of what is compared."""

    def residuals(self, pair: Intensities) -> Float[AnyArray, "points"]:
        """The part of f that noise explains."""

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Gauss and Newton's curvature of E_s in the values m_q, positive semidefinite."""

    def curvature(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """The curvature of E_s in the values m_q."""

    def variance(self) -> Scalar:
        """The mean of the residuals' variances in units of their squared scales."""

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Residuals that follow the model, in units of their scales."""

    def of_one_point(self) -> Pointwise:
        """The noise of a point by itself."""


SIMILARITIES: Mapping[str, type[Similarity]] = {
    **POINTWISE,
    "lncc": LocalCorrelation,
    "mi": MutualInformation,
    # Of the descriptors, by which a pair is then compared.
    "mind": SumOfSquaredDifferences,
}
