"""From images, a mesh and options to the arrays of a registration problem, with every input checked."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.special import betaln

from bayesreg.distance import MARGIN, shared_distance
from bayesreg.fem.determinant import schur_determinant
from bayesreg.fem.elasticity import rigid_modes
from bayesreg.fem.elements import GAUSS_SUBDIVISIONS, Quadrature, gauss_quadrature, quadrature_at
from bayesreg.fem.equilibrium import elastic_system
from bayesreg.fem.location import locate
from bayesreg.fem.operators import sparse_operator
from bayesreg.image import Image, Interpolation, Interpolator
from bayesreg.mesh import TetMesh
from bayesreg.model.constraint import is_allowed
from bayesreg.model.field import stiffness_field
from bayesreg.model.options import FieldConfig, Lame, ModelConfig, PriorConfig, TemperaturePrior, of_tissue
from bayesreg.model.program import LameParameter, RegistrationData
from bayesreg.types import AnyArray, InputError

# The solve feeds E_s, whose error is of first order in it: tighter than the default of the solve.
TOLERANCE = 1e-10


def registration_data(
    fixed: Image,
    moving: Image,
    mesh: TetMesh,
    model: ModelConfig,
    skull: Image | None,
    reference: Mapping[str, AnyArray] | None,
) -> tuple[RegistrationData, Int[np.ndarray, "sampled"]]:
    """All arrays of the problem, and the sampled nodes; see `bayesreg.build_posterior`."""
    require_overlap(mesh, fixed, "fixed image")
    require_overlap(mesh, moving, "moving image")
    sampled, held = sampled_nodes(mesh, model)
    require_proper(mesh, model)
    prescribed = np.union1d(sampled, list(held)).astype(int)
    lam, mu = (lame_parameter(name, mesh, model, reference) for name in ("lam", "mu"))
    entry = cell_entries(mesh, model)
    quadrature = quadrature_of(mesh, fixed, model)
    positions = quadrature.positions(mesh)
    displacement = np.zeros((len(prescribed), 3))
    displacement[np.searchsorted(prescribed, list(held)).astype(int)] = list(held.values()) or np.zeros((0, 3))
    distance = None if skull is None or not len(sampled) else skull_distance(skull, mesh, sampled)
    slots = np.searchsorted(prescribed, sampled)
    data = RegistrationData(
        system=elastic_system(
            mesh, prescribed, np.asarray(lam.reference)[entry], np.asarray(mu.reference)[entry], TOLERANCE
        ),
        cell_entry=jnp.asarray(entry),
        lam=lam,
        mu=mu,
        field=stiffness_field(mesh, model.field or FieldConfig()) if model.elasticity == "field" else None,
        moving=moving.interpolator(model.interpolation),
        skull_distance=distance,
        quadrature=quadrature,
        positions=jnp.asarray(positions),
        fixed_values=fixed.interpolate(positions, model.interpolation),
        points_sampled=jnp.asarray(mesh.points[sampled]),
        slots=jnp.asarray(slots),
        placed=sparse_operator(scipy.sparse.eye_array(len(prescribed), format="csc")[:, slots]),
        held=jnp.asarray(displacement),
        rigid_modes=jnp.asarray(rigid_modes(mesh.points[sampled]) if len(sampled) else np.zeros((0, 6))),
        rigid_sd=jnp.asarray(np.inf if model.rigid_sd is None else model.rigid_sd),
        t_similarity=jnp.asarray(_centre(model.t_similarity)),
        t_elastic=jnp.asarray(_centre(model.t_elastic)),
        temperature_log_sd={
            name: jnp.asarray(prior.log_sd)
            for name, prior in (("t_similarity", model.t_similarity), ("t_elastic", model.t_elastic))
            if isinstance(prior, TemperaturePrior)
        },
        degrees_of_freedom=jnp.asarray(model.degrees_of_freedom),
        independent_share=jnp.asarray(independent_share(model, len(positions))),
        determinant=schur_determinant(mesh, sampled, np.array(list(held), int)) if model.normalised else None,
    )
    return data, sampled


def _centre(temperature: float | TemperaturePrior) -> float:
    return temperature.median if isinstance(temperature, TemperaturePrior) else temperature


def require_proper(mesh: TetMesh, model: ModelConfig) -> None:
    """Raise InputError if the density is normalised and a free parameter of a tissue of the mesh has a flat prior."""
    try:
        model.require_proper_priors(mesh.names)
    except ValueError as error:
        raise InputError(f"model.priors: {error}") from None


def independent_share(model: ModelConfig, points: int) -> float:
    """Effective number of independent quadrature points over the number of all.

    Raises
    ------
    InputError
        If there are fewer points than are said to be independent.
    """
    if model.independent_points is None:
        return 1.0
    if model.independent_points > points:
        raise InputError(
            f"model.independent_points is {model.independent_points:g}, but the quadrature has {points} points; "
            "give at most as many, or null for all"
        )
    return model.independent_points / points


def require_overlap(mesh: TetMesh, image: Image, name: str) -> None:
    """Raise InputError if less than half of the mesh's nodes lie on the image's grid."""
    inside = image.contains(mesh.points)
    if inside.mean() < 0.5:
        corners = image.voxel_to_world(np.array([(0, 0, 0), np.array(image.shape) - 1]))
        raise InputError(
            f"the {name} and the mesh do not overlap: {inside.sum()} of {len(inside)} nodes lie on its grid. It runs "
            f"from {corners[0].round(1).tolist()} to {corners[1].round(1).tolist()} mm (world RAS), the mesh from "
            f"{mesh.points.min(0).round(1).tolist()} to {mesh.points.max(0).round(1).tolist()} mm; "
            "check the affines, or align the images first"
        )


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
    spread = np.linalg.svd(prescribed - prescribed.mean(axis=0), compute_uv=False)
    if len(prescribed) < 3 or spread[1] < 1e-6 * spread[0]:
        raise InputError(
            f"{len(prescribed)} sampled and held nodes do not hold the mesh in place: "
            "give at least three that are not on one line (model.sampled, model.held)"
        )
    return sampled, held


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
        is_free=jnp.array([k is None for k in known]),
        reference=jnp.asarray(values),
    )


def _default_reference(name: Lame, mesh: TetMesh, model: ModelConfig, entries: int) -> Float[np.ndarray, "entries"]:
    """λ = 10, μ = 1 (the literature's λ/μ is about 24); fluid-like 0.01 in CSF."""
    solid = 10.0 if name == "lam" else 1.0
    by_tissue = np.array([0.01 if tissue == "csf" else solid for tissue in mesh.names])
    return {"uniform": np.full(1, solid), "element": by_tissue[mesh.tissue]}.get(model.elasticity, by_tissue)


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


def sparsely_compared(
    data: RegistrationData, mesh: TetMesh, fixed: Image, interpolation: Interpolation
) -> RegistrationData:
    """The data with the images compared at four points of every tetrahedron."""
    quadrature = gauss_quadrature(mesh, "gauss4")
    positions = quadrature.positions(mesh)
    return data._replace(
        quadrature=quadrature,
        positions=jnp.asarray(positions),
        fixed_values=fixed.interpolate(positions, interpolation),
    )


def quadrature_of(mesh: TetMesh, fixed: Image, model: ModelConfig) -> Quadrature:
    """The rule that the options name.

    Raises
    ------
    InputError
        If the rule is "voxels" and no voxel centre lies inside the mesh.
    """
    if model.quadrature in GAUSS_SUBDIVISIONS:
        return gauss_quadrature(mesh, model.quadrature)
    centres = fixed.grid_points().reshape(-1, 3)
    near = centres[((centres >= mesh.points.min(axis=0)) & (centres <= mesh.points.max(axis=0))).all(axis=1)]
    cells, barycentric = locate(mesh.points, mesh.cells, near)
    inside = cells >= 0
    if not inside.any():
        raise InputError("no voxel centre of the fixed image lies inside the mesh: quadrature 'voxels' has no points")
    weights = np.full(inside.sum(), fixed.voxel_volume)
    return quadrature_at(mesh, cells[inside], barycentric[inside], weights)
