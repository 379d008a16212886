"""Compute the predictions that need the posterior itself, once after sampling; the report reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.spatial import cKDTree

from bayesreg.fem.location import interpolation_at
from bayesreg.inference.draws.predictive import Summary, push_forward, summarise, thin
from bayesreg.io.records import Predicted
from bayesreg.mesh import TetMesh
from bayesreg.model import coordinates
from bayesreg.model.observations.observation import Checked, Summarised
from bayesreg.model.posterior import Posterior
from bayesreg.model.state import state_of
from bayesreg.pose import Pose, compose, rigid_projection
from bayesreg.results.transform import Transform
from bayesreg.tissues import label_of
from bayesreg.types import AnyArray

Places = Mapping[str, tuple[float, float, float]]

MOST_DRAWS = 400
FAR = 2.0
REACH = 0.95
STIFFER = 1.5


def mean_values(posterior: Posterior, draws: xr.Dataset, u_mean: Float[np.ndarray, "nodes 3"]) -> dict[str, AnyArray]:
    """Compute the values of all blocks, known ones included, at the mean of the draws."""
    names = [name for name in posterior.reference() if name in draws and name != "u_boundary"]
    means = {name: draws[name].mean(("chain", "draw")).to_numpy() for name in names}
    return posterior.fill({**means, "u_boundary": u_mean[posterior.sampled]})


def predict(
    posterior: Posterior,
    draws: xr.Dataset,
    mean: dict[str, AnyArray],
    u_mean: Float[np.ndarray, "nodes 3"],
    u_sd: Float[np.ndarray, "nodes 3"],
    places: Places,
    seed: int,
    pose: Pose,
) -> Predicted:
    """Compute predictions of at most 400 evenly spaced draws: u at nodes and places, stiffness, residuals, replicates.

    Parameters
    ----------
    posterior : Posterior
    draws : xarray.Dataset
        The group `posterior` of the run.
    mean : dict
        Values of all blocks at the mean of the draws (`mean_values`).
    u_mean, u_sd : (n, 3) arrays
        Posterior mean and standard deviation at every node over all draws, mm.
    places : mapping
        Places by name (world RAS of the fixed image, mm); if it is empty, `default_places` chooses some.
    seed : int
        The seed of the replicated noise.
    pose : Pose
        The rigid motion from the posterior's world to the world of the moving image.

    Raises
    ------
    InputError
        If a place lies outside the mesh.
    """
    mesh = posterior.mesh
    checked = {
        name: observation for name, observation in posterior.observations.items() if isinstance(observation, Checked)
    }
    places = places or default_places(mesh, u_mean, u_sd)
    nodes, weights = _interpolation(mesh, places)
    centre, projection = rigid_projection(mesh.points, mesh.nodal_volumes)
    arrays = (u_mean, nodes, weights, projection)
    shared = posterior.data, *(jnp.asarray(array) for array in arrays)
    key = jax.random.key(seed)

    def forward(draw: dict[str, AnyArray], arguments: Any) -> dict[str, AnyArray]:
        data, u_mean, nodes, weights, projection = arguments
        number = draw.pop("number")
        state = state_of(data.body, data.blocks, coordinates.fill(data.blocks, draw))
        u = state.u
        distance, stiffness = jnp.linalg.norm(u - u_mean, axis=1), data.body.stiffness_factor(draw)
        predictions = {"u": u, "distance": distance, "far": (distance > FAR).astype(float),
                       "places": jnp.einsum("la,lai->li", weights, u[nodes]),
                       "motion": jnp.einsum("aki,ki->a", projection, u),
                       "stiffness": stiffness, "stiffer": (stiffness > STIFFER).astype(float)}  # fmt: skip
        of_draw = jax.random.fold_in(key, number.astype(int))
        for name, observation in checked.items():
            # The noise depends on the name, so that other observations of the run do not change it.
            noise = jax.random.fold_in(of_draw, crc32(name.encode()))
            figures = observation.check_draw(data.terms[name], state, noise)
            predictions |= {f"{name}/{figure}": value for figure, value in figures.items()}
        return predictions

    thinned = thin(draws, [name for name in posterior.reference() if name in draws], MOST_DRAWS)
    chains, count = thinned["u_boundary"].shape[:2]
    thinned["number"] = np.arange(chains * count, dtype=float).reshape(chains, count)
    pieces_by_name: dict[str, list[np.ndarray]] = {}
    summary = summarise(_keep_aside(push_forward(forward, thinned, shared), pieces_by_name), (REACH,))
    kept_arrays = {name: np.concatenate(pieces, axis=1) for name, pieces in pieces_by_name.items()}
    return Predicted(
        chain_mean=summary.chain_mean["u"],
        far_mm=np.array(FAR),
        far=summary.mean["far"],
        reach=summary.quantiles["distance"][0],
        place_names=np.array(list(places)),
        place_points=np.array(list(places.values()), float),
        place_draws=kept_arrays.pop("places"),
        motion=np.concatenate(compose(pose, centre, kept_arrays.pop("motion")), axis=-1),
        centre=centre,
        observations=kept_arrays | _summaries(posterior, mean, thinned),
        **(_stiffness(summary) if posterior.data.body.field is not None else {}),
    )


def _summaries(
    posterior: Posterior, mean: Mapping[str, AnyArray], thinned: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Collect the arrays that the observations compute for the report, by "<observation>/<array>"."""
    state = state_of(posterior.data.body, posterior.data.blocks, posterior.fill(mean))
    draws = {name: values.reshape(-1, *values.shape[2:]) for name, values in thinned.items() if name != "number"}
    summarised = {
        name: observation for name, observation in posterior.observations.items() if isinstance(observation, Summarised)
    }
    return {
        f"{name}/{key}": value
        for name, observation in summarised.items()
        for key, value in observation.summarise(posterior, state, draws).items()
    }


def with_unresolved(predicted: Predicted, transform: Transform) -> Predicted:
    """Add to the predictions the displacement that the mesh cannot resolve (`bayesreg.results.transform.Transform`)."""
    places = np.asarray(predicted.place_points)
    sd = transform.unresolved_sd(transform.deformer.locate(places))
    draws = np.asarray(predicted.place_draws)
    # The stream number len(draws) is free: the draws use the numbers below it.
    rng = np.random.default_rng((transform.seed, len(transform.draws)))
    return predicted._replace(place_draws=draws + sd * rng.standard_normal(draws.shape))


def _stiffness(summary: Summary) -> dict[str, np.ndarray]:
    return {
        "stiffness_mean": summary.mean["stiffness"],
        "stiffness_sd": summary.sd["stiffness"],
        "stiffer": np.array(STIFFER),
        "stiffer_probability": summary.mean["stiffer"],
    }


def _keep_aside(
    blocks: Iterator[dict[str, Any]], pieces_by_name: dict[str, list[np.ndarray]]
) -> Iterator[dict[str, Any]]:
    """Move small entries of blocks (places, motion, checks of observations) to `pieces_by_name`; yield the others."""
    for block in blocks:
        for name in [name for name in block if name in ("places", "motion") or "/" in name]:
            pieces_by_name.setdefault(name, []).append(block.pop(name))
        yield block


def require_inside(mesh: TetMesh, places: Places) -> None:
    """Raise InputError if a place lies outside the mesh; no displacement is estimated there."""
    _interpolation(mesh, places)


def _interpolation(mesh: TetMesh, places: Places) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (place, 4) and the barycentric weights (place, 4) of places in the mesh."""
    points = np.array(list(places.values()), float).reshape(-1, 3)
    return interpolation_at(mesh, points, [f"place {name!r}" for name in places])


def default_places(
    mesh: TetMesh, u_mean: Float[np.ndarray, "nodes 3"], u_sd: Float[np.ndarray, "nodes 3"]
) -> dict[str, tuple[float, float, float]]:
    """Choose the nodes of the largest shift, the largest sd and the greatest depth, and the middle of each tissue.

    The middle of a tissue is the centre of its tetrahedron nearest to its centroid.
    """
    depth, _ = cKDTree(mesh.points[mesh.boundary]).query(mesh.points)
    centres = mesh.points[mesh.cells].mean(axis=1)
    places = {
        "largest shift": mesh.points[np.linalg.norm(u_mean, axis=1).argmax()],
        "largest sd": mesh.points[np.linalg.norm(u_sd, axis=1).argmax()],
        "deepest point": mesh.points[depth.argmax()],
    }
    for index, name in enumerate(mesh.names):
        inside = mesh.tissue == index
        if inside.any():
            centroid = np.average(centres[inside], axis=0, weights=mesh.volumes[inside])
            nearest = np.linalg.norm(centres[inside] - centroid, axis=1).argmin()
            places[f"middle of {label_of(name)}"] = centres[inside][nearest]
    return {name: (float(x), float(y), float(z)) for name, (x, y, z) in places.items()}
