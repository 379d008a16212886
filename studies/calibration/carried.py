"""How often what `bayesreg apply` tells of points and labels holds the truth, over cases whose posterior is sampled.

The truth is displaced by random loads, on the mesh that registers or on one of half the edges, which the registering
mesh cannot follow. Each case counts once: one point on the way there, one on the way back, and one voxel of a label
map.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.fem.deformation import Deformer, Displaced
from bayesreg.image import Image
from bayesreg.model.observations.landmarks_report import surprise
from bayesreg.model.submesh import submesh_variance
from bayesreg.pose import Pose
from bayesreg.results.carried_labels import carry_labels
from bayesreg.results.transform import Transform, spread
from studies.calibration import sbc
from studies.calibration.chains import simulated
from studies.calibration.simulator import DEGREES_OF_FREEDOM, MESH, VARIANTS, Simulator
from tests.phantoms import box_mesh, smooth_image

LEVELS = (0.5, 0.9, 0.95)
SETTINGS = sbc.Settings(replications=200, draws=300)
# The box is [0, 20] mm; what goes back starts where every truth has a source in it.
THERE, BACK = (0.5, 19.5), (4.0, 16.0)
LABELS = 4


# By the ellipsoids of points.csv; and by their parts: the draws, linear in each tetrahedron, alone, and with one of the
# two that `Transform` adds to them.
PARTS = ("as written", "the draws", "the draws and what the mesh cannot follow", "the nodes, interpolated")


class Case(NamedTuple):
    """How improbable the truth is: the probability of the region about the most probable that just holds it.

    Attributes
    ----------
    there, back : (4,) arrays
        Of a point on its way there and back, by each of `PARTS`.
    label : float
        Of the label of a voxel, a random share of its own probability included.
    """

    there: np.ndarray
    back: np.ndarray
    label: float


def measure(
    finer: bool, seed: int = 0, settings: sbc.Settings = SETTINGS, say: sbc.Say = lambda text: None
) -> np.ndarray:
    """Every case, (r, 9), in the order of `Case`."""
    mesh = box_mesh(4) if finer else MESH
    simulator = Simulator(VARIANTS["loads"], mesh)
    rng = np.random.default_rng(seed)
    truths = simulator.draw_prior(rng, settings.replications)
    key_data, key_chains = jax.random.split(jax.random.key(seed))
    observed = _seen(simulator, truths, key_data)
    starts = Simulator(VARIANTS["loads"]).draw_prior(rng, settings.replications)
    found = sbc.sample(simulator.posterior, observed, starts, key_chains, settings, say=say)
    say(f"acceptance {found.acceptance.min():.0%} to {found.acceptance.max():.0%}")
    registered, true = Deformer(MESH), Deformer(mesh)
    labels = _labels()
    cases = []
    for case, u in enumerate(truths["u_boundary"]):
        draws = found.u[:, case]
        transform = Transform(registered, Pose.identity(), draws.mean(axis=0), draws, seed=case)
        cases.append(_case(transform, true.displaced(u), labels, rng))
    return np.array([np.hstack(case) for case in cases])


def _seen(simulator: Simulator, truths: dict[str, np.ndarray], key: Any) -> Any:
    """The fixed image at the quadrature points, (r, q), as the truth displaces the moving one."""
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
    """Blobs of a few millimetres, in voxels of half a millimetre."""
    coarse = smooth_image(MESH.points, seed=7, blur=1.0)
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 3] = -4.0
    grid = Image(np.zeros((56, 56, 56)), affine)
    values = coarse.interpolate(grid.grid_points())
    return grid.with_voxels(1 + np.digitize(values, np.quantile(values, np.arange(1, LABELS) / LABELS)))


def _case(transform: Transform, truth: Displaced, labels: Image, rng: np.random.Generator) -> Case:
    there, back = rng.uniform(*THERE, (1, 3)), rng.uniform(*BACK, (1, 3))
    truly_there = there + truth.displacement(there, truth.deformer.locate(there))
    truly_back, _ = truth.sources(back)
    affine = np.eye(4)
    affine[:3, 3] = rng.uniform(*BACK, 3)
    voxel = Image(np.zeros((1, 1, 1)), affine)
    source, _ = truth.sources(voxel.grid_points().reshape(-1, 3))
    told = {value: float(share.item()) for value, share in carry_labels(transform, labels, voxel).probabilities()}
    return Case(
        _improbable(transform, there, truly_there),
        _improbable(transform.inverse, back, truly_back),
        _improbable_label(told, int(labels.nearest(source)[0]), rng),
    )


def _improbable(transform: Transform, points: np.ndarray, truly: np.ndarray) -> np.ndarray:
    """By each of `PARTS`."""
    found = spread(transform, points)
    _, near = transform.place(points)
    drawn = transform.covariance(near) - np.eye(3) * transform.unresolved_sd(near)[:, :, None] ** 2
    submesh = submesh_variance(transform.mesh, transform.u_mean)[near.cell]
    nodes = transform.covariance(near) - np.eye(3) * submesh[:, :, None]
    every = (found.covariance, drawn, drawn + np.eye(3) * submesh[:, :, None], nodes)
    return np.concatenate([surprise(truly - found.places, covariance) for covariance in every])


def _improbable_label(told: dict[int, float], true: int, rng: np.random.Generator) -> float:
    above = sum(share for value, share in told.items() if share > told[true])
    tied = sum(share for value, share in told.items() if share == told[true])
    return above + rng.uniform() * tied
