"""The arrays of a registration problem, made from a mesh, observations and options after a check of every input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.special import betaln

from bayesreg.distance import MARGIN, shared_distance
from bayesreg.fem.determinant import schur_determinant
from bayesreg.fem.elasticity import rigid_modes
from bayesreg.fem.elements import elements_of
from bayesreg.fem.equilibrium import elastic_system
from bayesreg.fem.operators import sparse_operator
from bayesreg.image import Image
from bayesreg.interpolation import Interpolator
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import (
    LAME,
    Blocks,
    Coefficients,
    Displacement,
    FieldScale,
    scale_block,
)
from bayesreg.model.elastic.barrier import Barrier
from bayesreg.model.elastic.rigid import RigidPrior
from bayesreg.model.elastic.skull import Skull, SoftSkull, is_allowed
from bayesreg.model.field import StiffnessField, stiffness_field
from bayesreg.model.lame_parameter import LameParameter
from bayesreg.model.observations.observation import Placed, place
from bayesreg.model.options import (
    FieldConfig,
    Lame,
    LamePrior,
    ModelConfig,
    PriorConfig,
    is_reserved_name,
    of_tissue,
)
from bayesreg.model.priors import Entries
from bayesreg.model.program import Problem
from bayesreg.model.state import Body, StaticMesh
from bayesreg.model.term import Terms
from bayesreg.settings import ScalePrior
from bayesreg.tissues import SOLID, usual_value
from bayesreg.types import AnyArray, InputError

# The elastic solve affects E_s to first order, so its tolerance is smaller than the solver's default.
TOLERANCE = 1e-10

# In place of the other kind of prior, an entry has a flat one of positive numbers, or a log-normal one without effect.
POSITIVE, UNUSED = PriorConfig(low=float(np.finfo(float).tiny)), ScalePrior(median=1.0)


def problem_of(
    mesh: TetMesh,
    observations: Sequence[Any],
    model: ModelConfig,
    skull: Image | None,
    reference: Mapping[str, AnyArray] | None,
) -> tuple[Problem, Int[np.ndarray, "sampled"], dict[str, Any]]:
    """Make the problem, the sampled nodes and the prepared observations; see `bayesreg.build_posterior`."""
    sampled, held = sampled_nodes(mesh, model)
    require_proper(mesh, model)
    body, blocks = body_of(mesh, model, reference)
    # The observations come first, so that errors in them are reported before any long computation.
    placed = place_observations(mesh, observations, model.preset)
    for entry in placed.values():
        blocks |= entry.blocks
    terms: Terms = {name: placement.term for name, placement in placed.items()}
    terms |= _priors(mesh, model, sampled, held, skull)
    return Problem(body, blocks, terms), sampled, {name: placement.observation for name, placement in placed.items()}


def place_observations(mesh: TetMesh, observations: Sequence[Any], preset: str) -> dict[str, Placed]:
    """Place the observations on a mesh, by name.

    Raises
    ------
    InputError
        If two have one name, or a name of an observation or of an unknown that it brings is taken.
    """
    placed: dict[str, Placed] = {}
    for observation in observations:
        if observation.name in placed or is_reserved_name(observation.name):
            raise InputError(f"the name {observation.name!r} of an observation is taken; give another one")
        placed[observation.name] = place(observation, mesh, preset)
    owners: dict[str, str] = {}
    for name, placement in placed.items():
        for block in placement.blocks:
            if block in owners or block in placed or is_reserved_name(block):
                raise InputError(f"the name {block!r} of an unknown of {name!r} is taken; rename the latter")
            owners[block] = name
    return placed


def body_of(mesh: TetMesh, model: ModelConfig, reference: Mapping[str, AnyArray] | None = None) -> tuple[Body, Blocks]:
    """Make the elastic body and its unknowns, from which displacements are computed."""
    sampled, held = sampled_nodes(mesh, model)
    field = stiffness_field(mesh, model.field or FieldConfig()) if model.elasticity == "field" else None
    blocks = _blocks(mesh, model, sampled, field, reference)
    return _body(mesh, model, sampled, held, field, blocks), blocks


def _blocks(
    mesh: TetMesh,
    model: ModelConfig,
    sampled: Int[np.ndarray, "sampled"],
    field: StiffnessField | None,
    reference: Mapping[str, AnyArray] | None,
) -> Blocks:
    blocks: Blocks = {
        "u_boundary": Displacement(jnp.asarray(mesh.points[sampled])),
        "lam": lame_parameter("lam", mesh, model, reference),
        "mu": lame_parameter("mu", mesh, model, reference),
        **{name: scale_block(scale) for name, scale in model.elastic_prior.scales.items()},
    }
    if field is not None:
        blocks |= {"field": Coefficients(jnp.ones(field.basis.shape[1])), "field_sd": FieldScale(field.sd_scale)}
    return blocks


def _body(
    mesh: TetMesh,
    model: ModelConfig,
    sampled: Int[np.ndarray, "sampled"],
    held: Mapping[int, tuple[float, float, float]],
    field: StiffnessField | None,
    blocks: Blocks,
) -> Body:
    prescribed = np.union1d(sampled, list(held)).astype(int)
    sampled_index = np.searchsorted(prescribed, sampled)
    displacement = np.zeros((len(prescribed), 3))
    displacement[np.searchsorted(prescribed, list(held)).astype(int)] = list(held.values()) or np.zeros((0, 3))
    entry = cell_entries(mesh, model)
    lam, mu = (np.asarray(blocks[name].reference())[entry] for name in LAME)
    return Body(
        mesh=StaticMesh(mesh),
        system=elastic_system(mesh, prescribed, lam, mu, TOLERANCE),
        cell_entry=jnp.asarray(entry),
        field=field,
        sampled_index=jnp.asarray(sampled_index),
        scatter_to_prescribed=sparse_operator(scipy.sparse.eye_array(len(prescribed), format="csc")[:, sampled_index]),
        held=jnp.asarray(displacement),
    )


def _priors(
    mesh: TetMesh,
    model: ModelConfig,
    sampled: Int[np.ndarray, "sampled"],
    held: Mapping[int, tuple[float, float, float]],
    skull: Image | None,
) -> Terms:
    """Make the elastic prior, rigid prior, barrier and skull; none of them if u_B is given."""
    terms: Terms = {}
    if not len(sampled):
        return terms
    normalised = model.elastic_prior.normalised
    determinant = schur_determinant(mesh, sampled, np.array(list(held), int)) if normalised else None
    terms["elastic"] = model.elastic_prior.on(mesh, determinant)
    if model.rigid_sd is not None:
        terms["rigid"] = RigidPrior(jnp.asarray(rigid_modes(mesh.points[sampled])), jnp.asarray(model.rigid_sd))
    if model.least_volume:
        terms["barrier"] = Barrier(jnp.asarray(model.least_volume), elements_of(mesh))
    if skull is not None:
        hard = Skull(skull_distance(skull, mesh, sampled), jnp.asarray(mesh.points[sampled]))
        width = model.skull_width * skull.voxel_volume ** (1 / 3)
        soft = SoftSkull(hard, jnp.asarray(sampled), jnp.asarray(width))
        terms["skull"] = soft if model.skull_width else hard
    return terms


def require_proper(mesh: TetMesh, model: ModelConfig) -> None:
    """Raise InputError if the density is normalised and a free parameter of a tissue of the mesh has a flat prior."""
    try:
        model.require_proper_priors(mesh.names)
    except ValueError as error:
        raise InputError(f"model.priors: {error}") from None


def skull_distance(skull: Image, mesh: TetMesh, sampled: Int[np.ndarray, "sampled"]) -> Interpolator:
    """Return the signed distance to the skull, for jitted code.

    Raises
    ------
    InputError
        If a sampled node lies in the skull before it has moved.
    """
    distance = shared_distance(skull, MARGIN).interpolator("linear")
    inside = np.flatnonzero(~np.asarray(is_allowed(distance, jnp.asarray(mesh.points[sampled]))))
    if len(inside):
        node = sampled[inside[0]]
        raise InputError(
            f"{len(inside)} of {len(sampled)} sampled nodes lie in the skull before they have moved, the first is node "
            f"{node} at {mesh.points[node].round(1).tolist()} mm; check that nonzero means forbidden in the skull "
            "image, and that mesh and skull share one space"
        )
    return distance


def sampled_nodes(mesh: TetMesh, model: ModelConfig) -> tuple[np.ndarray, dict[int, tuple[float, float, float]]]:
    """Return the sorted sampled nodes (without the held ones), and the held nodes with their displacements.

    Raises
    ------
    InputError
        If a node does not exist, none is sampled and not all of the boundary is held, or sampled and held nodes
        together are fewer than three or on one line.
    """
    count = len(mesh.points)
    elastic = model.elastic_prior
    if elastic.nodes == "boundary":
        wanted = mesh.boundary
    elif elastic.nodes == "all":
        wanted = np.arange(count)
    else:
        wanted = np.unique(np.asarray(elastic.nodes, int))
    held = dict(sorted(elastic.held.items()))
    for name, nodes in (("nodes", wanted), ("held", np.array(list(held), int))):
        if len(nodes) and nodes.max() >= count:
            raise InputError(
                f"model.elastic_prior.{name} names node {nodes.max()}, but the mesh has {count} nodes (0 to "
                f"{count - 1})"
            )
    sampled = np.setdiff1d(wanted, list(held)).astype(int)
    prescribed = mesh.points[np.union1d(sampled, list(held)).astype(int)]
    unknown = np.setdiff1d(mesh.boundary, list(held))
    if len(sampled) == 0 and len(unknown):
        raise InputError(
            "no node is sampled: model.elastic_prior.nodes names none that is not held. Elastography, λ and μ alone, "
            f"needs every boundary node held (model.elastic_prior.held); {len(unknown)} of {len(mesh.boundary)} are "
            f"not, the first is node {unknown[0]}"
        )
    if not determine_pose(prescribed):
        raise InputError(
            f"{len(prescribed)} sampled and held nodes do not hold the mesh in place: "
            "give at least three that are not on one line (nodes and held of model.elastic_prior)"
        )
    return sampled, held


def determine_pose(points: Float[np.ndarray, "k 3"]) -> bool:
    """Check whether fixed points determine the pose of a rigid body: at least three, not on one line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) >= 3 and bool(spread[1] >= 1e-6 * spread[0])


def cell_entries(mesh: TetMesh, model: ModelConfig) -> Int[np.ndarray, "cells"]:
    """Return the index of each cell's entry in λ and μ."""
    return {
        "tissue": mesh.tissue,
        "uniform": np.zeros(len(mesh.cells), int),
        "element": np.arange(len(mesh.cells)),
        "field": mesh.tissue,
    }[model.elasticity]


def lame_parameter(
    name: Lame, mesh: TetMesh, model: ModelConfig, reference: Mapping[str, AnyArray] | None
) -> LameParameter:
    """Make the block of λ or μ with its prior, known entries and reference values.

    Raises
    ------
    InputError
        If the options name a tissue that the mesh does not have, two tissues that share one entry are given
        different values, or the reference has the wrong shape or sign.
    """
    entries = {"uniform": 1, "element": len(mesh.cells)}.get(model.elasticity, len(mesh.names))
    given = model.with_default_priors(mesh.names).priors.get(name, PriorConfig())
    priors = _by_entry(f"priors.{name}", given, PriorConfig(), mesh, model, entries)
    fixed = model.known(mesh.names)
    fixed_values = _by_entry(f"fixed.{name}", fixed.get(name), None, mesh, model, entries)
    if reference is None:
        start = _within(priors, _default_reference(name, mesh, model, entries))
    else:
        start = np.asarray(reference[name], float)
    if start.shape != (entries,) or not (np.isfinite(start) & (start > 0)).all():
        raise InputError(f"reference[{name!r}] must be {entries} positive numbers, got {start.tolist()}")
    values = np.array([s if k is None else float(k) for s, k in zip(start, fixed_values, strict=True)])
    ranges = [prior if isinstance(prior, PriorConfig) else POSITIVE for prior in priors]
    log_normal = [prior if isinstance(prior, ScalePrior) else UNUSED for prior in priors]
    alpha, beta = (np.array([float(getattr(p, name)) for p in ranges]) for name in ("alpha", "beta"))
    return LameParameter(
        alpha=jnp.asarray(alpha),
        beta=jnp.asarray(beta),
        low=jnp.array([float(p.low) for p in ranges]),
        high=jnp.array([float(p.high) for p in ranges]),
        log_beta=jnp.asarray(betaln(alpha, beta)),
        median=jnp.array([p.median for p in log_normal]),
        log_sd=jnp.array([p.log_sd for p in log_normal]),
        log_normal=Entries(np.array([isinstance(prior, ScalePrior) for prior in priors])),
        free=Entries(np.array([k is None for k in fixed_values])),
        at_rest=jnp.asarray(values),
    )


def _default_reference(name: Lame, mesh: TetMesh, model: ModelConfig, entries: int) -> Float[np.ndarray, "entries"]:
    by_tissue = np.array([usual_value(name, tissue) for tissue in mesh.names])
    return {"uniform": np.full(1, SOLID[name]), "element": by_tissue[mesh.tissue]}.get(model.elasticity, by_tissue)


def _within(priors: list[LamePrior], values: Float[np.ndarray, "entries"]) -> Float[np.ndarray, "entries"]:
    """Replace values by the median of a log-normal prior, and values outside the range of another by a value inside."""
    return np.array([_value_within(prior, float(value)) for prior, value in zip(priors, values, strict=True)])


def _value_within(prior: LamePrior, value: float) -> float:
    if isinstance(prior, ScalePrior):
        return prior.median
    if prior.low < value < prior.high:
        return value
    return prior.low + value if np.isinf(prior.high) else (prior.low + prior.high) / 2


def _by_entry(where: str, option: object, default: object, mesh: TetMesh, model: ModelConfig, entries: int) -> list:
    """Return one option for each entry of λ or μ, from one value for all or a mapping by tissue."""
    if not isinstance(option, Mapping):
        return [default if option is None else option] * entries
    unknown = set(option) - set(mesh.names)
    if unknown:
        raise InputError(f"model.{where} names {sorted(unknown)}, but the mesh's tissues are {list(mesh.names)}")
    if model.elasticity == "uniform" and len(set(option.values())) > 1:
        raise InputError(f"model.{where} gives tissues different values, but elasticity is uniform: {dict(option)}")
    tissues = {"uniform": mesh.names[:1], "element": [mesh.names[t] for t in mesh.tissue]}
    options = (of_tissue(model, option, tissue) for tissue in tissues.get(model.elasticity, mesh.names))
    return [default if value is None else value for value in options]
