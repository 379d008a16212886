"""From images, a mesh and options to the arrays of a registration problem, with every input checked."""

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
    FreeEntries,
    LameParameter,
    Scale,
)
from bayesreg.model.field import StiffnessField, stiffness_field
from bayesreg.model.image_pair import ImagePair
from bayesreg.model.intensity_map import SHARE
from bayesreg.model.options import (
    FieldConfig,
    Lame,
    ModelConfig,
    PriorConfig,
    ScalePrior,
    TemperaturePrior,
    is_taken,
    of_tissue,
    require_default_image_options,
)
from bayesreg.model.program import Problem
from bayesreg.model.state import Body, StaticMesh
from bayesreg.model.terms.barrier import Barrier
from bayesreg.model.terms.elastic import SCALES, BoltzmannPrior, LoadPrior
from bayesreg.model.terms.images import ComparedImages, shading_name
from bayesreg.model.terms.landmarks import Landmarks
from bayesreg.model.terms.rigid import RigidPrior
from bayesreg.model.terms.skull import Skull, SoftSkull, is_allowed
from bayesreg.model.terms.term import Outside, Terms
from bayesreg.tissues import SOLID, usual_value
from bayesreg.types import AnyArray, InputError

# The solve feeds E_s, whose error is of first order in it: tighter than the default of the solve.
TOLERANCE = 1e-10


def problem_of(
    mesh: TetMesh,
    observations: Sequence[Any],
    model: ModelConfig,
    skull: Image | None,
    reference: Mapping[str, AnyArray] | None,
) -> tuple[Problem, Int[np.ndarray, "sampled"]]:
    """All arrays of the problem, and the sampled nodes; see `bayesreg.build_posterior`."""
    if all(isinstance(one, Landmarks) for one in observations):
        require_default_image_options(model)
    sampled, held = sampled_nodes(mesh, model)
    require_proper(mesh, model)
    body, blocks = body_of(mesh, model, reference)
    blocks |= observation_blocks(observations)
    # The observations first: what is wrong with them is told before anything that takes long.
    terms = observation_terms(mesh, observations, model)
    blocks |= _temperature_blocks(terms, model) | _shading_blocks(terms)
    terms |= _priors(mesh, model, sampled, held, skull)
    return Problem(body, blocks, terms), sampled


def body_of(mesh: TetMesh, model: ModelConfig, reference: Mapping[str, AnyArray] | None = None) -> tuple[Body, Blocks]:
    """The elastic body and the unknowns that it brings: what it takes to turn draws into displacements."""
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
        "t_similarity": _scale(model.t_similarity),
        **{name: _scale(getattr(model, name)) for name in SCALES[model.elastic_prior]},
    }
    if field is not None:
        blocks |= {"field": Coefficients(jnp.ones(field.basis.shape[1])), "field_sd": FieldScale(field.sd_scale)}
    return blocks


def _scale(given: float | ScalePrior) -> Scale:
    if isinstance(given, ScalePrior):
        return Scale(jnp.asarray(given.median), jnp.asarray(given.log_sd))
    return Scale(jnp.asarray(given))


def _body(
    mesh: TetMesh,
    model: ModelConfig,
    sampled: Int[np.ndarray, "sampled"],
    held: Mapping[int, tuple[float, float, float]],
    field: StiffnessField | None,
    blocks: Blocks,
) -> Body:
    prescribed = np.union1d(sampled, list(held)).astype(int)
    slots = np.searchsorted(prescribed, sampled)
    displacement = np.zeros((len(prescribed), 3))
    displacement[np.searchsorted(prescribed, list(held)).astype(int)] = list(held.values()) or np.zeros((0, 3))
    entry = cell_entries(mesh, model)
    lam, mu = (np.asarray(blocks[name].reference())[entry] for name in LAME)
    return Body(
        mesh=StaticMesh(mesh),
        system=elastic_system(mesh, prescribed, lam, mu, TOLERANCE),
        cell_entry=jnp.asarray(entry),
        field=field,
        slots=jnp.asarray(slots),
        placed=sparse_operator(scipy.sparse.eye_array(len(prescribed), format="csc")[:, slots]),
        held=jnp.asarray(displacement),
    )


def _temperature_blocks(terms: Terms, model: ModelConfig) -> Blocks:
    """T_s of every pair of images."""
    pairs = [term for term in terms.values() if isinstance(term, ComparedImages)]
    return {pair.comparison.temperature: _scale(model.t_similarity) for pair in pairs}


def _shading_blocks(terms: Terms) -> Blocks:
    """The coefficients of the shading of every pair of images that has one, see `bayesreg.model.intensity_map`."""
    pairs = [term for term in terms.values() if isinstance(term, ComparedImages)]
    bases = {shading_name(pair.name): pair.shading for pair in pairs}
    return {name: Coefficients(jnp.full(one.shape[1], SHARE)) for name, one in bases.items() if one is not None}


def observation_blocks(observations: Sequence[Any]) -> Blocks:
    """The unknowns that observations bring, by name; InputError if a name is taken."""
    found: Blocks = {}
    for observation in observations:
        for name, block in getattr(observation, "blocks", {}).items():
            if name in found or is_taken(name):
                raise InputError(f"the name {name!r} of an unknown of {observation.name!r} is taken; rename the latter")
            found[name] = block
    return found


def observation_terms(mesh: TetMesh, observations: Sequence[Any], model: ModelConfig) -> Terms:
    """The terms of observations by name.

    Raises
    ------
    InputError
        If one is no observation, or two have one name, or one has a name that is taken.
    """
    terms: Terms = {}
    unknowns = observation_blocks(observations)
    for observation in observations:
        name = observation.name
        if name in terms or name in unknowns or is_taken(name):
            raise InputError(f"the name {name!r} of an observation is taken; give another one")
        if isinstance(observation, ImagePair):
            # The first pair's T_s is that of the options, and all share it where it is known.
            first = not any(isinstance(term, ComparedImages) for term in terms.values())
            shared = first or not isinstance(model.t_similarity, TemperaturePrior)
            terms[name] = observation.on(mesh, model, "t_similarity" if shared else f"{name}_t_similarity")
        elif isinstance(observation, Landmarks):
            terms[name] = observation.on(mesh)
        else:
            terms[name] = Outside(observation)
    return terms


def _priors(
    mesh: TetMesh,
    model: ModelConfig,
    sampled: Int[np.ndarray, "sampled"],
    held: Mapping[int, tuple[float, float, float]],
    skull: Image | None,
) -> Terms:
    """Elastic prior, rigid prior, barrier and skull. Where u_B is given none is there: u_I follows from it, λ and μ."""
    terms: Terms = {}
    if not len(sampled):
        return terms
    determinant = schur_determinant(mesh, sampled, np.array(list(held), int)) if model.normalised else None
    loads = model.elastic_prior == "loads"
    terms["elastic"] = LoadPrior.on(mesh, determinant) if loads else BoltzmannPrior(determinant)
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
    """Signed distance to the skull, for jitted code.

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
    """Sorted sampled nodes (held ones left out), and the held nodes with their displacements.

    Raises
    ------
    InputError
        If a node does not exist, none is sampled and not all of the boundary is held, or sampled and held nodes
        together are fewer than three or on one line.
    """
    count = len(mesh.points)
    if model.sampled == "boundary":
        wanted = mesh.boundary
    elif model.sampled == "all":
        wanted = np.arange(count)
    else:
        wanted = np.unique(np.asarray(model.sampled, int))
    held = dict(sorted(model.held.items()))
    for name, nodes in (("sampled", wanted), ("held", np.array(list(held), int))):
        if len(nodes) and nodes.max() >= count:
            raise InputError(
                f"model.{name} names node {nodes.max()}, but the mesh has {count} nodes (0 to {count - 1})"
            )
    sampled = np.setdiff1d(wanted, list(held)).astype(int)
    prescribed = mesh.points[np.union1d(sampled, list(held)).astype(int)]
    unknown = np.setdiff1d(mesh.boundary, list(held))
    if len(sampled) == 0 and len(unknown):
        raise InputError(
            "no node is sampled: model.sampled names none that is not held. Elastography, λ and μ alone, needs every "
            f"boundary node held (model.held); {len(unknown)} of {len(mesh.boundary)} are not, the first is node "
            f"{unknown[0]}"
        )
    if not fix_a_body(prescribed):
        raise InputError(
            f"{len(prescribed)} sampled and held nodes do not hold the mesh in place: "
            "give at least three that are not on one line (model.sampled, model.held)"
        )
    return sampled, held


def fix_a_body(points: Float[np.ndarray, "k 3"]) -> bool:
    """Whether a rigid body rests where these of its points do: three at least, and not on one line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) >= 3 and bool(spread[1] >= 1e-6 * spread[0])


def cell_entries(mesh: TetMesh, model: ModelConfig) -> Int[np.ndarray, "cells"]:
    """Index of each cell's entry in λ and μ."""
    return {
        "tissue": mesh.tissue,
        "uniform": np.zeros(len(mesh.cells), int),
        "element": np.arange(len(mesh.cells)),
        "field": mesh.tissue,
    }[model.elasticity]


def lame_parameter(
    name: Lame, mesh: TetMesh, model: ModelConfig, reference: Mapping[str, AnyArray] | None
) -> LameParameter:
    """Prior, known entries and reference values of λ or μ.

    Raises
    ------
    InputError
        If the options name a tissue that the mesh does not have, two tissues that share one entry are given
        different values, or the reference has the wrong shape or sign.
    """
    entries = {"uniform": 1, "element": len(mesh.cells)}.get(model.elasticity, len(mesh.names))
    prior = _by_entry(f"priors.{name}", model.priors.get(name, PriorConfig()), PriorConfig(), mesh, model, entries)
    fixed = model.known(mesh.names)
    known = _by_entry(f"fixed.{name}", fixed.get(name), None, mesh, model, entries)
    if reference is None:
        start = _within(prior, _default_reference(name, mesh, model, entries))
    else:
        start = np.asarray(reference[name], float)
    if start.shape != (entries,) or not (np.isfinite(start) & (start > 0)).all():
        raise InputError(f"reference[{name!r}] must be {entries} positive numbers, got {start.tolist()}")
    values = np.array([s if k is None else float(k) for s, k in zip(start, known, strict=True)])
    alpha, beta = (np.array([float(getattr(p, name)) for p in prior]) for name in ("alpha", "beta"))
    return LameParameter(
        alpha=jnp.asarray(alpha),
        beta=jnp.asarray(beta),
        low=jnp.array([float(p.low) for p in prior]),
        high=jnp.array([float(p.high) for p in prior]),
        log_beta=jnp.asarray(betaln(alpha, beta)),
        free=FreeEntries(np.array([k is None for k in known])),
        at_rest=jnp.asarray(values),
    )


def _default_reference(name: Lame, mesh: TetMesh, model: ModelConfig, entries: int) -> Float[np.ndarray, "entries"]:
    by_tissue = np.array([usual_value(name, tissue) for tissue in mesh.names])
    return {"uniform": np.full(1, SOLID[name]), "element": by_tissue[mesh.tissue]}.get(model.elasticity, by_tissue)


def _within(prior: list[PriorConfig], values: Float[np.ndarray, "entries"]) -> Float[np.ndarray, "entries"]:
    """The values, those outside the range of their prior replaced by one inside."""
    low, high = np.array([(p.low, p.high) for p in prior]).T
    inside = np.where(np.isinf(high), low + values, (low + high) / 2)
    return np.where((values > low) & (values < high), values, inside)


def _by_entry(where: str, given: object, default: object, mesh: TetMesh, model: ModelConfig, entries: int) -> list:
    """One option per entry of λ or μ, from one for all or a mapping by tissue."""
    if not isinstance(given, Mapping):
        return [default if given is None else given] * entries
    unknown = set(given) - set(mesh.names)
    if unknown:
        raise InputError(f"model.{where} names {sorted(unknown)}, but the mesh's tissues are {list(mesh.names)}")
    if model.elasticity == "uniform" and len(set(given.values())) > 1:
        raise InputError(f"model.{where} gives tissues different values, but elasticity is uniform: {dict(given)}")
    tissues = {"uniform": mesh.names[:1], "element": [mesh.names[t] for t in mesh.tissue]}
    found = (of_tissue(model, given, tissue) for tissue in tissues.get(model.elasticity, mesh.names))
    return [default if value is None else value for value in found]
