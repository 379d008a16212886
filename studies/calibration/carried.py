"""How often the points and labels of `bayesreg apply` agree with the truth, over cases whose posterior is sampled.

Random loads displace the true body, on the registering mesh or on a mesh of half the edge length, which the registering
mesh cannot follow. Each case has one point that is mapped forward, one point that is mapped by the inverse, and one
voxel of a label map.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import bayesreg as br
from bayesreg.fem.deformation import Deformer, Displaced
from bayesreg.image import Image
from bayesreg.model import coordinates
from bayesreg.model.observations.landmarks_report import region_probability
from bayesreg.model.submesh import Unresolved, unresolved_in
from bayesreg.pose import Pose
from bayesreg.results.carried_labels import carry_labels
from bayesreg.results.transform import Transform, spread
from studies.calibration import sbc
from studies.calibration.chains import PARAMETERS, simulated
from studies.calibration.simulator import DEGREES_OF_FREEDOM, MESH, VARIANTS, Simulator
from tests.phantoms import box_mesh, smooth_image

LEVELS = (0.5, 0.9, 0.95)
SETTINGS = sbc.Settings(replications=200, draws=300)
# The box is [0, 20] mm. Every point of the smaller range has a source in the box.
FORWARD_RANGE, INVERSE_RANGE = (0.5, 19.5), (4.0, 16.0)
LABELS = 4


# The ellipsoids of points.csv, and those of the draws alone, which are linear in each tetrahedron.
COVARIANCES = ("as written", "the draws")


class Case(NamedTuple):
    """The probability of the smallest credible region that contains the truth.

    Attributes
    ----------
    forward, inverse : (2,) arrays
        The probability for a point that is mapped forward, and by the inverse, with each of `COVARIANCES`.
    label : float
        The probability for the label of a voxel; it includes a random share of the probability of the true label.
    """

    forward: np.ndarray
    inverse: np.ndarray
    label: float


def measure(
    finer: bool, seed: int = 0, settings: sbc.Settings = SETTINGS, report_progress: sbc.Progress = lambda text: None
) -> np.ndarray:
    """Return all cases as an array (r, 5), in the order of `Case`."""
    mesh = box_mesh(4) if finer else MESH
    simulator = Simulator(VARIANTS["loads"], mesh)
    posterior = simulator.posterior
    rng = np.random.default_rng(seed)
    truths = simulator.draw_prior(rng, settings.replications)
    key_data, key_chains = jax.random.split(jax.random.key(seed))
    observed = _observed_images(simulator, truths, key_data)
    starts = Simulator(VARIANTS["loads"]).draw_prior(rng, settings.replications)
    sampled = sbc.sample(posterior, observed, starts, key_chains, settings, report_progress=report_progress)
    report_progress(f"acceptance {sampled.acceptance.min():.0%} to {sampled.acceptance.max():.0%}")
    registered, true = Deformer(MESH), Deformer(mesh)
    labels = _labels()
    cases = []
    for case, u in enumerate(truths["u_boundary"]):
        draws = sampled.u[:, case]
        unresolved = _unresolved(posterior, sampled.quantities[:, case].mean(axis=0), draws)
        transform = Transform(registered, Pose.identity(), draws.mean(axis=0), draws, unresolved, seed=case)
        cases.append(_case(transform, true.displaced(u), labels, rng))
    return np.array([np.hstack(case) for case in cases])


def _unresolved(posterior: br.Posterior, quantities: np.ndarray, draws: np.ndarray) -> Unresolved:
    """Make the distribution of what the mesh cannot resolve, at the loads and the stiffness among test quantities."""
    estimands = posterior.estimands(posterior.reference())
    first = 0
    for name in [name for name in PARAMETERS if name in estimands]:
        end = first + np.size(estimands[name])
        estimands[name] = quantities[first:end].reshape(np.shape(estimands[name]))
        first = end
    return unresolved_in(posterior.data.body, coordinates.complete(posterior.data.blocks, estimands), draws)


def _observed_images(simulator: Simulator, truths: dict[str, np.ndarray], key: Any) -> Any:
    """Simulate the fixed images at the quadrature points, (r, q), from the true displacements."""
    posterior, data = simulator.posterior, simulator.posterior.data
    if simulator.mesh is MESH:
        return simulated(posterior, data, truths, key)
    images, deformer = data.terms["images"], Deformer(simulator.mesh)
    points = np.asarray(images.positions)
    location = deformer.locate(points)
    moved = np.stack([points + deformer.displaced(u).displacement(points, location) for u in truths["u_boundary"]])
    scale = jnp.sqrt(truths["t_similarity"][:, None] / (2 * images.quadrature.weights))
    return jax.lax.map(images.moving, moved) + scale * jax.random.t(key, DEGREES_OF_FREEDOM, scale.shape)


def _labels() -> Image:
    """Make a label map of blobs of a few millimetres, in voxels of half a millimetre."""
    coarse = smooth_image(MESH.points, seed=7, blur=1.0)
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 3] = -4.0
    grid = Image(np.zeros((56, 56, 56)), affine)
    values = coarse.interpolate(grid.grid_points())
    return grid.with_voxels(1 + np.digitize(values, np.quantile(values, np.arange(1, LABELS) / LABELS)))


def _case(transform: Transform, truth: Displaced, labels: Image, rng: np.random.Generator) -> Case:
    forward, inverse = rng.uniform(*FORWARD_RANGE, (1, 3)), rng.uniform(*INVERSE_RANGE, (1, 3))
    true_forward = forward + truth.displacement(forward, truth.deformer.locate(forward))
    true_inverse, _ = truth.sources(inverse)
    affine = np.eye(4)
    affine[:3, 3] = rng.uniform(*INVERSE_RANGE, 3)
    voxel = Image(np.zeros((1, 1, 1)), affine)
    source, _ = truth.sources(voxel.grid_points().reshape(-1, 3))
    probabilities = {
        value: float(share.item()) for value, share in carry_labels(transform, labels, voxel).probabilities()
    }
    return Case(
        _improbable(transform, forward, true_forward),
        _improbable(transform.inverse, inverse, true_inverse),
        _improbable_label(probabilities, int(labels.nearest(source)[0]), rng),
    )


def _improbable(transform: Transform, points: np.ndarray, true_places: np.ndarray) -> np.ndarray:
    """Return the probability of the region that contains the true place, for each of `COVARIANCES`."""
    predicted = spread(transform, points)
    _, location = transform.place(points)
    added = transform.unresolved.covariance_at(location.cell, location.barycentric)
    added += transform.averaged_sd(location)[:, :, None] ** 2 * np.eye(3)
    drawn = transform.covariance(location) - added
    away = true_places - predicted.places
    return np.concatenate([region_probability(away, covariance) for covariance in (predicted.covariance, drawn)])


def _improbable_label(probabilities: dict[int, float], true: int, rng: np.random.Generator) -> float:
    above = sum(share for value, share in probabilities.items() if share > probabilities[true])
    tied = sum(share for value, share in probabilities.items() if share == probabilities[true])
    return above + rng.uniform() * tied
