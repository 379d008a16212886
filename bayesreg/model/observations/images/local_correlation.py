"""Local normalised cross-correlation, for pairs of unlike contrast: squared differences after a local affine map.

Another sequence, or a bias field, changes intensities by a map that is nearly affine within some millimetres. The
quadrature points are therefore divided into windows. In window k the model is f = a_k m + b_k + noise, with unknown
a_k, b_k and Gaussian noise of the variance T_s / (2 w_q), as in eq. (1). At the best a_k, b_k

E_s = Σ_k min_{a, b} Σ_{q ∈ k} w_q (f_q − a m_q − b)² = Σ_k V_k var_k(f) (1 − ncc_k²),

where V_k = Σ w_q. The variances and the correlation ncc_k of f and the warped m within the window are weighted by w_q.
The minimum lies at a = cov(f, m) / var(m) and b = mean(f) − a mean(m), and the remaining mean square is var(f) − cov(f,
m)² / var(m). If a = 1 and b = 0 are best everywhere, this is eq. (1), so that T_s, its noise and its prior keep their
meaning. Each window uses two degrees of freedom of the noise: of N residuals in K windows, N − 2K are independent. The
normaliser takes this into account if T_s is inferred. The likelihood is a profile likelihood; an integral over a_k and
b_k with flat priors would prefer a warped m without contrast.

E_s is equal for m and s m + c, also with a negative s. A window with an almost constant m explains nothing: var(m) is
increased by `RIDGE` times the variance of m over all points, which is a Normal prior of a_k with mean zero.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.fem.operators import SparseOperator, sparse_operator
from bayesreg.interpolation import Interpolator
from bayesreg.model.observations.images.pointwise import (
    Intensities,
    SimilaritySettings,
    SumOfSquaredDifferences,
    ValueCurvature,
    total,
)
from bayesreg.model.term import SharedCurvature
from bayesreg.settings import Positive
from bayesreg.types import AnyArray, InputError, Scalar

# Fewest points of a window: each window uses two degrees of freedom.
LEAST = 16
# Share of the variance of m: the square of a hundredth of its sd, which is less than the noise of most images.
RIDGE = 1e-4


class Windows(NamedTuple):
    """A partition of all points (a pytree).

    Attributes
    ----------
    label : (q,) int array
        The window of each point.
    members : SparseOperator
        (k, q): one where a point lies in a window.
    """

    label: Int[AnyArray, "points"]
    members: SparseOperator

    @property
    def number(self) -> int:
        """The number of windows."""
        return len(self.members.matrix.starts) - 1

    def sums(self, values: Float[AnyArray, "points columns"]) -> Float[AnyArray, "points columns"]:
        """Sum values over the window of each point, and return the sum at that point."""
        return self.members.transpose(self.members(values))


class LocalFit(NamedTuple):
    """The best affine map of intensities in the window of each point, and properties of the window (all (q,)).

    Attributes
    ----------
    volume : (q,) array
        V, mm³.
    fixed, moving : (q,) arrays
        f and m less their means.
    variance : (q,) array
        Of m.
    gain : (q,) array
        a.
    residuals : (q,) array
        r = f − a m − b.
    """

    volume: Float[AnyArray, "points"]
    fixed: Float[AnyArray, "points"]
    moving: Float[AnyArray, "points"]
    variance: Float[AnyArray, "points"]
    gain: Float[AnyArray, "points"]
    residuals: Float[AnyArray, "points"]


class WindowCorrelation(NamedTuple):
    """Squared differences after the best affine map of intensities in each window; see `Similarity`.

    Attributes
    ----------
    windows : Windows
    ridge : scalar
        Added to the variance of m within a window, squared intensity.
    width : scalar
        Longest side of a window, mm.
    """

    windows: Windows
    ridge: Scalar
    width: Scalar

    def fit(self, pair: Intensities) -> LocalFit:
        """Fit the best map in every window."""
        weights = pair.weights * pair.shares
        volume, *sums = self.windows.sums(weights[:, None] * jnp.stack([jnp.ones_like(weights), *pair[:2]], axis=1)).T
        # A window that is not compared at all has the weight zero.
        volume = jnp.maximum(volume, jnp.finfo(volume.dtype).tiny)
        f, m = (values - values_sum / volume for values, values_sum in zip(pair[:2], sums, strict=True))
        covariance, variance = self.windows.sums(jnp.stack([weights * f * m, weights * m**2], axis=1)).T / volume
        gain = covariance / (variance + self.ridge)
        return LocalFit(volume, f, m, variance, gain, f - gain * m)

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return Σ_k V_k (var_k(f) − cov_k(f, m)² / (var_k(m) + ridge)), which does not depend on the temperature."""
        return _energy(self, pair._replace(weights=pair.weights * pair.shares, share=None))

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return the log normaliser of Gaussian noise in N − 2K dimensions, up to a constant."""
        lost = self.windows.number * jnp.log(jnp.pi * temperature)
        return total(pair.shares, 0.5 * jnp.log(pair.weights / (jnp.pi * temperature))) + lost

    def residuals(self, pair: Intensities) -> Float[AnyArray, "points"]:
        """Return the residuals f − a m − b."""
        return self.fit(pair).residuals

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return `curvature` for residuals of zero: twice a² W minus its projection on the maps of every window."""
        return self._curvature(self.fit(pair), pair.weights * pair.shares, jnp.zeros_like(pair.fixed))

    def curvature(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return Σ_k 2a² (W − w wᵀ / V) − 2 v vᵀ / (V (var(m) + ridge)), v = w (r − a (m − mean(m))), W = diag(w).

        It is the derivative of the gradient −2 w a r, where r and a depend on m.
        """
        fit = self.fit(pair)
        return self._curvature(fit, pair.weights * pair.shares, fit.residuals)

    def _curvature(
        self, fit: LocalFit, weights: Float[AnyArray, "points"], residuals: Float[AnyArray, "points"]
    ) -> ValueCurvature:
        of_mean = weights * fit.gain
        of_gain = weights * (residuals - fit.gain * fit.moving) / jnp.sqrt(fit.variance + self.ridge)
        vectors = jnp.sqrt(2 / fit.volume) * jnp.stack([of_mean, of_gain])
        shared = SharedCurvature(self.windows.label, vectors, -jnp.ones(2))
        return ValueCurvature(2 * weights * fit.gain**2, shared)

    def variance(self) -> Scalar:
        """Return the mean variance (N − 2K) / N."""
        return jnp.asarray(1 - 2 * self.windows.number / len(self.windows.label))

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw standard Normal numbers minus the part that an affine map of m explains in each window."""
        scale = jnp.sqrt(pair.weights)
        noise = jax.random.normal(key, scale.shape) / scale
        return scale * self.residuals(pair._replace(fixed=noise, share=None))

    def expected_slope(self, pair: Intensities) -> None:
        """Return None; see `Similarity`."""
        return

    def of_one_point(self) -> SumOfSquaredDifferences:
        """Return Gaussian noise, the noise of one point."""
        return SumOfSquaredDifferences()


@jax.custom_jvp
def _energy(similarity: WindowCorrelation, pair: Intensities) -> Scalar:
    fit = similarity.fit(pair)
    return total(pair.weights, fit.fixed * fit.residuals)


@_energy.defjvp
def _energy_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Scalar, Scalar]:
    """Compute the derivative with a and b fixed, since E_s is minimal in them; the second derivative varies them."""
    (similarity, pair), (_, change) = primals, tangents
    fit = similarity.fit(pair)
    slope = total(2 * pair.weights * fit.residuals, change.fixed - fit.gain * change.moving)
    slope += total(fit.residuals**2 + similarity.ridge * fit.gain**2, change.weights)
    return total(pair.weights, fit.fixed * fit.residuals), slope


def windows_of(positions: Float[np.ndarray, "points 3"], width: float) -> Windows:
    """Divide points into boxes: halve the longest side while it exceeds the width and both halves have enough points.

    Parameters
    ----------
    positions : (q, 3) array
        mm.
    width : float
        Longest side, mm; more where a box would have fewer than `LEAST` points.
    """
    label, window, boxes = np.zeros(len(positions), int), 0, [np.arange(len(positions))]
    while boxes:
        box = boxes.pop()
        sides = np.ptp(positions[box], axis=0)
        if sides.max() <= width or len(box) < 2 * LEAST:
            label[box] = window
            window += 1
        else:
            along = np.argsort(positions[box, sides.argmax()], kind="stable")
            boxes += np.array_split(box[along], 2)
    members = scipy.sparse.csr_array((np.ones(len(label)), (label, np.arange(len(label)))))
    return Windows(jnp.asarray(label), sparse_operator(members))


class LocalCorrelation(SimilaritySettings):
    """Squared differences after the best affine map of intensities in each of many windows, for unlike contrasts."""

    serves_any_contrast = True
    formula = (
        "Σ <var>wr</var>², where <var>r</var> is what the best affine map of <var>m</var>(<var>x</var> + "
        "<var>u</var>) leaves of <var>f</var> in the window of a quadrature point of weight <var>w</var>"
    )
    residual = "what the best affine map of the intensities of m in each window leaves of f"

    kind: Literal["lncc"] = "lncc"
    window_mm: Positive = 10.0
    """Longest side of a window, mm, within which one affine map should relate the contrasts. Where the quadrature has
    few points, windows are as much larger as to hold 16."""

    def on(
        self, positions: Float[np.ndarray, "points 3"], rest: Intensities, fixed: Interpolator, blur: float = 0.0
    ) -> WindowCorrelation:
        """Make the similarity at these points; see `AnySimilarity`.

        Raises
        ------
        InputError
            If the moving image is constant at the points.
        """
        values = rest.moving
        # Rounding changes the spline of a constant image.
        if jnp.ptp(values) <= 1e-9 * abs(values).max():
            raise InputError("the moving image is constant in the mesh: similarity 'lncc' has nothing to correlate")
        ridge, width = RIDGE * values.var(), jnp.asarray(self.window_mm)
        return WindowCorrelation(windows_of(positions, self.window_mm), ridge, width)
