"""Similarities of two images at quadrature points; the likelihood is exp(−E_s / T_s) / Z_s, eq. (11)."""

from __future__ import annotations

from typing import Protocol, get_args

from jaxtyping import Float

from bayesreg.model.observations.images.linear_combination import LinearCombination
from bayesreg.model.observations.images.local_correlation import LocalCorrelation
from bayesreg.model.observations.images.mutual_information import MutualInformation
from bayesreg.model.observations.images.pointwise import (
    Intensities,
    Pointwise,
    SquaredDifferences,
    StudentT,
    ValueCurvature,
)
from bayesreg.model.observations.images.self_similarity import SelfSimilarity
from bayesreg.types import AnyArray, Scalar


class Similarity(Protocol):
    """The comparison of f and the warped m in the likelihood (a pytree).

    The argument `temperature` is T_s, mm³ times squared intensity.
    """

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return E_s, mm³ times squared intensity."""

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return −log Z_s, with which exp(−E_s / T_s) is a density of the residuals of the compared values."""

    def residuals(self, pair: Intensities) -> Float[AnyArray, "points"]:
        """Return the part of f that noise explains."""

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return the Gauss–Newton curvature of E_s in the values m_q, positive semidefinite."""

    def curvature(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return the curvature of E_s in the values m_q."""

    def expected_slope(self, pair: Intensities) -> Float[AnyArray, "points 3"] | None:
        """Return the gradient of m that f predicts, without that of the noise of m; None where it predicts none."""

    def variance(self) -> Scalar:
        """Return the mean of the residuals' variances in units of their squared scales."""

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw residuals from the model, in units of their scales."""

    def of_one_point(self) -> Pointwise:
        """Return the noise of a single point."""


AnySimilarity = (
    SquaredDifferences | StudentT | LinearCombination | LocalCorrelation | MutualInformation | SelfSimilarity
)
"""The settings of a similarity. Its method `on(positions, rest, fixed, blur)` makes the `Similarity` at some points
(q, 3), mm, of images with the `Intensities` `rest` there where nothing has moved. f is the function `fixed`, and `blur`
is the sd of the smoothing of the images, mm."""

SIMILARITIES = {settings.model_fields["kind"].default: settings for settings in get_args(AnySimilarity)}
