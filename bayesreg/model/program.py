"""The generative model of section 3.1 as a NumPyro program."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jaxtyping import Bool, Float, Int
from numpyro.distributions import constraints

from bayesreg.fem.determinant import SchurDeterminant, log_pseudo_determinant
from bayesreg.fem.elasticity import total_strain_energy
from bayesreg.fem.elements import Quadrature
from bayesreg.fem.equilibrium import ElasticSystem, equilibrium
from bayesreg.fem.operators import SparseOperator
from bayesreg.image import Interpolator
from bayesreg.model.constraint import is_allowed
from bayesreg.model.field import StiffnessField
from bayesreg.model.neighbourhood import Neighbourhoods
from bayesreg.model.priors import ScaledBeta
from bayesreg.model.similarity import SIMILARITIES, Noise
from bayesreg.types import AnyArray, Scalar


class LameParameter(NamedTuple):
    """Prior and known entries of λ or of μ (a pytree).

    Attributes
    ----------
    alpha, beta, low, high : (entries,) arrays
        Of the scaled Beta prior of each entry.
    log_beta : (entries,) array
        log B(α, β).
    is_free : (entries,) bool array
        False where the parameter is known.
    reference : (entries,) array
        The known value, or the one at which the interior solve is preconditioned and chains may start, and which is
        the scale of the coordinate where there is no upper bound.
    """

    alpha: Float[AnyArray, "entries"]
    beta: Float[AnyArray, "entries"]
    low: Float[AnyArray, "entries"]
    high: Float[AnyArray, "entries"]
    log_beta: Float[AnyArray, "entries"]
    is_free: Bool[AnyArray, "entries"]
    reference: Float[AnyArray, "entries"]

    def prior(self) -> dist.Distribution:
        """p(λ) or p(μ), with known entries left out of the density."""
        return ScaledBeta(self.alpha, self.beta, self.low, self.high, self.log_beta).mask(self.is_free).to_event(1)


class RegistrationData(NamedTuple):
    """All arrays of one registration problem (a pytree, an argument of every jitted function).

    Attributes
    ----------
    system : ElasticSystem
    cell_entry : (m,) int array
        Index of each cell's entry in λ and μ.
    lam, mu : LameParameter
    field : StiffnessField or None
        Prior of the logarithm of a factor on λ and μ of every cell.
    moving : Interpolator
    skull_distance : Interpolator or None
        Signed distance to Ω_SK, mm.
    quadrature : Quadrature
    positions : (q, 3) array
        World positions x_q of the quadrature points, mm.
    fixed_values : (q,) array
        f(x_q).
    points_sampled : (b, 3) array
        Positions of the sampled nodes, mm.
    slots : (b,) int array
        Where the sampled nodes stand among `system.prescribed`.
    placed : SparseOperator
        (prescribed, b): what belongs to the sampled nodes, in their slots; zero in the others.
    held : (prescribed, 3) array
        Known displacements, zero in the rows of sampled nodes, mm.
    rigid_modes : (3b, 6) array
        Orthonormal basis of the sampled nodes' infinitesimal rigid motions.
    rigid_sd : scalar
        Infinite for the flat prior.
    t_similarity, t_elastic : scalars
        The known temperatures T_s and T_r, or the medians of their priors.
    temperature_log_sd : mapping of name to scalar
        Of the log-normal priors of those temperatures that are inferred.
    degrees_of_freedom : scalar
        ν of Student's t noise.
    independent_share : scalar
        Effective number of independent quadrature points over that of all: tempers the likelihood.
    determinant : SchurDeterminant or None
        Of the elastic prior; None leaves its normaliser out.
    neighbourhoods : Neighbourhoods or None
        Of some nodes that are moved alone, see `local_logdensity`.
    """

    system: ElasticSystem
    cell_entry: Int[AnyArray, "cells"]
    lam: LameParameter
    mu: LameParameter
    field: StiffnessField | None
    moving: Interpolator
    skull_distance: Interpolator | None
    quadrature: Quadrature
    positions: Float[AnyArray, "points 3"]
    fixed_values: Float[AnyArray, "points"]
    points_sampled: Float[AnyArray, "boundary 3"]
    slots: Int[AnyArray, "boundary"]
    placed: SparseOperator
    held: Float[AnyArray, "prescribed 3"]
    rigid_modes: Float[AnyArray, "rows 6"]
    rigid_sd: Scalar
    t_similarity: Scalar
    t_elastic: Scalar
    temperature_log_sd: dict[str, Scalar]
    degrees_of_freedom: Scalar
    independent_share: Scalar
    determinant: SchurDeterminant | None
    neighbourhoods: Neighbourhoods | None = None

    @property
    def scales(self) -> tuple[str, ...]:
        """Names of the positive scalars that are sampled: temperatures with a prior, and the field's sd."""
        return (*self.temperature_log_sd, *(() if self.field is None else ("field_sd",)))


def registration(
    data: RegistrationData,
    similarity: str = "ssd",
    guess: Float[AnyArray, "nodes 3"] | None = None,
) -> None:
    """p(m, u, λ, μ) of eq. (8): the program whose log joint density is the posterior's up to a constant.

    The displacements have a flat base measure, on which the Boltzmann elastic prior (12), the rigid prior
    and the Boltzmann likelihood (11) are factors. The skull belongs to the likelihood: a configuration with
    a sampled node in Ω_SK cannot have produced the image. So does an elastic solve that failed. A `guess` of
    the displacement of all nodes speeds up the solve (see `equilibrium`).
    """
    flat = dist.ImproperUniform(constraints.real_matrix, (), event_shape=data.points_sampled.shape)
    u_boundary = numpyro.sample("u_boundary", flat)
    lam = numpyro.sample("lam", data.lam.prior())
    mu = numpyro.sample("mu", data.mu.prior())
    t_similarity, t_elastic = (_temperature(data, name) for name in ("t_similarity", "t_elastic"))

    field = _field(data)
    lam_cells, mu_cells = _by_cell(data, lam, mu, **field)
    u_prescribed = prescribed(data, u_boundary)
    state = equilibrium(data.system, lam_cells, mu_cells, u_prescribed, guess)

    elements, quadrature = data.system.elements, data.quadrature
    moved = data.positions + quadrature.interpolation(state.u)
    likelihood, noise = SIMILARITIES[similarity], Noise(t_similarity, data.degrees_of_freedom)
    similarity_energy = likelihood.energy(data.fixed_values, data.moving(moved), quadrature.weights, noise)
    strain_energy = total_strain_energy(elements, lam_cells, mu_cells, state.u)
    # Without the barrier XLA computes both energies twice, for the density and for the record.
    similarity_energy, strain_energy = jax.lax.optimization_barrier((similarity_energy, strain_energy))
    inside = in_support(data, u_boundary, lam, mu, t_similarity, t_elastic, **field)

    numpyro.factor("log_similarity", -data.independent_share * similarity_energy / t_similarity)
    if "t_similarity" in data.temperature_log_sd:
        log_normaliser = likelihood.log_normaliser(quadrature.weights, noise)
        numpyro.factor("log_similarity_normaliser", data.independent_share * log_normaliser)
    # E_r / T_r is minus the log prior of u_B. Where u_B is given there is none: u_I follows from it and θ.
    if len(data.slots):
        numpyro.factor("log_elastic", -strain_energy / t_elastic)
        numpyro.factor("log_rigid", _log_rigid_prior(data, data.rigid_modes.T @ u_boundary.reshape(-1)))
    if data.determinant is not None:
        numpyro.factor("log_normaliser", log_elastic_normaliser(data, lam, mu, t_elastic, **field))
    numpyro.factor("log_support", jnp.where(inside, 0.0, -jnp.inf))
    numpyro.factor("log_solved", jnp.where(state.converged, 0.0, -jnp.inf))

    numpyro.deterministic("u", state.u)
    numpyro.deterministic("similarity_energy", similarity_energy)
    numpyro.deterministic("strain_energy", strain_energy)
    numpyro.deterministic("solver_iterations", state.iterations)
    numpyro.deterministic("solver_failed", ~state.converged)
    numpyro.deterministic("outside_support", ~inside)


def prescribed(data: RegistrationData, u_boundary: Float[AnyArray, "boundary 3"]) -> Float[AnyArray, "prescribed 3"]:
    """Displacements of all nodes that have given ones, mm. (A product: of a scatter XLA makes a loop on the CPU.)"""
    return data.held + data.placed(u_boundary) if len(data.slots) else data.held


def local_logdensity(
    data: RegistrationData, similarity: str, values: Mapping[str, AnyArray], which: Int[AnyArray, ""]
) -> Callable[[Float[AnyArray, "3"]], Scalar]:
    """The log density as a function of the displacement of one node, up to a constant and approximately.

    Parameters
    ----------
    data : RegistrationData
        With neighbourhoods.
    similarity : str
    values : mapping
        Where the other nodes are. Those that have neighbourhoods count as if they were in the middle of theirs, so that
        the sum over these is one function of them all.
    which : scalar integer
        Of the neighbourhoods.
    """
    near, quadrature, likelihood = data.neighbourhoods, data.quadrature, SIMILARITIES[similarity]
    assert near is not None
    t_similarity, t_elastic = (values.get(name, getattr(data, name)) for name in ("t_similarity", "t_elastic"))
    noise = Noise(t_similarity, data.degrees_of_freedom)
    u_boundary = values["u_boundary"].at[near.rows].set(near.at)
    u_prescribed = prescribed(data, u_boundary)
    around = jnp.tensordot(near.response, u_prescribed, 2)

    row, points, follows, at = near.rows[which], near.points[which], near.follows[which], near.at[which]
    base = (quadrature.barycentric[points][:, :, None] * around[near.corners[which]]).sum(axis=1)
    places, fixed, weights = data.positions[points] + base, data.fixed_values[points], quadrature.weights[points]
    force = jnp.tensordot(near.force[which], u_prescribed, 2)
    stiffness = near.force[which][:, data.slots[row]]
    rigid = data.rigid_modes.T @ u_boundary.reshape(-1)
    rigid_modes = jax.lax.dynamic_slice_in_dim(data.rigid_modes, 3 * row, 3)

    def log(u: Float[AnyArray, "3"]) -> Scalar:
        away = u - at
        moved = data.moving(places + follows @ away)
        similarity_energy = likelihood.energy(fixed, moved, weights, noise)
        strain_energy = away @ force + 0.5 * away @ stiffness @ away
        total = -data.independent_share * similarity_energy / t_similarity - strain_energy / t_elastic
        total += _log_rigid_prior(data, rigid + rigid_modes.T @ away)
        if data.skull_distance is None:
            return total
        clear = is_allowed(data.skull_distance, (data.points_sampled[row] + u)[None])[0]
        return jnp.where(clear, total, -jnp.inf)

    return log


def local_equilibrium(
    data: RegistrationData, u_boundary: Float[AnyArray, "sampled 3"], which: Int[AnyArray, ""]
) -> Float[AnyArray, "3"]:
    """Elastic equilibrium of one node, mm: no force acts on it there while all other sampled and held nodes stay.

    At the λ and μ that the data are conditioned for. `which` is one of the neighbourhoods.
    """
    near = data.neighbourhoods
    assert near is not None
    row, force = near.rows[which], near.force[which]
    stiffness = force[:, data.slots[row]]
    u_prescribed = prescribed(data, u_boundary)
    return u_boundary[row] - jnp.linalg.solve(stiffness, jnp.tensordot(force, u_prescribed, 2))


def log_elastic_normaliser(
    data: RegistrationData, lam: AnyArray, mu: AnyArray, t_elastic: AnyArray, **field: AnyArray
) -> Scalar:
    """½ log pdet S(λ, μ) − r/2 log(2π T_r), r the rank of S: makes exp(−E_r / T_r) a density of u_B."""
    if data.determinant is None:
        return jnp.zeros(())
    log_pdet = log_pseudo_determinant(data.determinant, data.system.elements, *_by_cell(data, lam, mu, **field))
    return 0.5 * (log_pdet - data.determinant.rank * jnp.log(2 * jnp.pi * t_elastic))


def _temperature(data: RegistrationData, name: str) -> Scalar:
    """T_s or T_r, sampled where it has a prior."""
    known = getattr(data, name)
    if name not in data.temperature_log_sd:
        return known
    return numpyro.sample(name, dist.LogNormal(jnp.log(known), data.temperature_log_sd[name]))


def _field(data: RegistrationData) -> dict[str, AnyArray]:
    """The field's standard deviation and its whitened components, where there is a field."""
    if data.field is None:
        return {}
    components = dist.Normal(jnp.zeros(data.field.basis.shape[1]), 1.0).to_event(1)
    return {
        "field_sd": numpyro.sample("field_sd", dist.HalfNormal(data.field.sd_scale)),
        "field": numpyro.sample("field", components),
    }


def stiffness_factor(data: RegistrationData, field_sd: AnyArray | float, field: AnyArray) -> Float[AnyArray, "cells"]:
    """exp(sd · basis · z), by which the field multiplies λ and μ of every cell."""
    if data.field is None:
        return jnp.ones(data.cell_entry.shape)
    return jnp.exp(field_sd * (data.field.basis @ field))


def _by_cell(
    data: RegistrationData,
    lam: AnyArray,
    mu: AnyArray,
    field_sd: AnyArray | float = 1.0,
    field: AnyArray | float = 0.0,
) -> tuple[Float[AnyArray, "cells"], Float[AnyArray, "cells"]]:
    """λ and μ of every cell. Where K may be indefinite the density is −∞; the reference then lets a solve end soon."""
    physical = _physical(lam, mu)
    if data.field is not None:
        factor = stiffness_factor(data, field_sd, field)
        physical &= _finite(factor)
        factor = jnp.where(physical, factor, 1.0)
    safe = (jnp.where(physical, values, known.reference) for values, known in ((lam, data.lam), (mu, data.mu)))
    lam_entries, mu_entries = safe
    lam_cells, mu_cells = lam_entries[data.cell_entry], mu_entries[data.cell_entry]
    return (lam_cells, mu_cells) if data.field is None else (lam_cells * factor, mu_cells * factor)


def in_support(
    data: RegistrationData,
    u_boundary: AnyArray,
    lam: AnyArray,
    mu: AnyArray,
    t_similarity: AnyArray | float = 1.0,
    t_elastic: AnyArray | float = 1.0,
    field_sd: AnyArray | float = 1.0,
    field: AnyArray | float = 0.0,
) -> Bool[AnyArray, ""]:
    """Whether no sampled node lies in Ω_SK and every parameter is physical and in the range of its prior."""
    in_range = _in_range(lam, data.lam) & _in_range(mu, data.mu)
    warm = jnp.isfinite(t_similarity) & (t_similarity > 0) & jnp.isfinite(t_elastic) & (t_elastic > 0)
    warm &= jnp.asarray(field_sd) > 0
    if data.field is not None:
        warm &= _finite(stiffness_factor(data, field_sd, field))
    return _physical(lam, mu) & in_range & warm & _clear_of_skull(data, u_boundary)


def _physical(lam: AnyArray, mu: AnyArray) -> Bool[AnyArray, ""]:
    """Whether K is positive definite up to rigid motions: λ ≥ 0 and μ > 0, all of them finite."""
    return ((lam >= 0) & jnp.isfinite(lam)).all() & ((mu > 0) & jnp.isfinite(mu)).all()


def _finite(factor: AnyArray) -> Bool[AnyArray, ""]:
    return (jnp.isfinite(factor) & (factor > 0)).all()


def _in_range(values: AnyArray, parameter: LameParameter) -> Bool[AnyArray, ""]:
    return (~parameter.is_free | ((values >= parameter.low) & (values <= parameter.high))).all()


def _clear_of_skull(data: RegistrationData, u_boundary: Float[AnyArray, "boundary 3"]) -> Bool[AnyArray, ""]:
    if data.skull_distance is None:
        return jnp.array(True)
    return is_allowed(data.skull_distance, data.points_sampled + u_boundary).all()


def _log_rigid_prior(data: RegistrationData, coefficients: Float[AnyArray, "6"]) -> Scalar:
    """Gaussian on the root-mean-square displacement of each rigid mode over the sampled nodes."""
    mean_square = coefficients**2 / len(data.points_sampled)
    return -0.5 * (mean_square / data.rigid_sd**2).sum()
