"""The pose of an organ from points on its moved surface, without partners, from several starts.

A rigid motion takes the measured points y_k back to x_k = R (y_k − c) + c + t, about their centre c. These lie on the
surface at rest up to errors of Student's t of scale s, which hold what the organ deforms, too. With the depth φ below
the surface, the share κ of points that are independent, and a wide Normal prior of precision Λ for p, the rotation
vector and t less the shift that aligns the centres, reweighted least squares leads from each start to a mode of

log p = κ Σ_k (log t_ν(φ(x_k) / s) − log s) − ½ pᵀ Λ p,

and Laplace's approximation gives its evidence, log p − ½ log det(κ Jᵀ W J + Λ).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayesreg.distance import distance_at, slope_at
from bayesreg.image import Image
from bayesreg.model.observations.level_set import depth_in_mask
from bayesreg.model.observations.surface import Surface, count_independent
from bayesreg.pose import Pose

# Degrees of freedom of the errors.
FREEDOM = 4.0
# The number of random turns besides the 24 by right angles; each is tried with the points where they are, and with
# their centre at that of the organ. And the greatest number of points that are used.
TURNS, POINTS = 96, 200
# The sd of the prior of the six motions: mm and radians.
WIDE = np.repeat([100.0, 1.5], 3)
# The number of steps from every start, with this share κ, and from the poses to which they lead, with the share that is
# counted at the best of them; and the greatest motion of one step: mm and radians.
STEPS, LAST_STEPS, FIRST_SHARE, LONGEST = 50, 5, 0.1, np.repeat([15.0, 0.3], 3)
# The number of voxels along the longest side of the organ, in the grid of depths.
VOXELS = 64
# The least scale of the errors, mm.
LEAST_SCALE = 1e-3
# Poses that place the points so far apart in the mean are two, in lengths of the cloud of points.
APART = 0.1


class SurfacePose(NamedTuple):
    """The most probable pose, and what speaks for it.

    Attributes
    ----------
    pose : Pose
        From the world of the fixed image to that of the points.
    lead : float
        Its log evidence less that of the next pose; infinite if there is no other.
    starts : int
    """

    pose: Pose
    lead: float
    starts: int


def find_pose(surface: Surface, tissue: Image, names: Sequence[str]) -> SurfacePose:
    """Find the pose of greatest evidence.

    Parameters
    ----------
    surface : Surface
        Its points are in the world of the moving image.
    tissue : Image
        Labels at rest: 0 outside, 1 + index into the names inside.
    names : sequence of str
    """
    y = np.random.default_rng(0).permutation(surface.points)[:POINTS]
    centre, mask = y.mean(axis=0), surface.mask(tissue, names)
    size = np.ptp(mask.voxel_to_world(np.argwhere(np.asarray(mask.voxels))), axis=0).max()
    edges = np.maximum(mask.voxel_sizes, size / VOXELS)
    depth = depth_in_mask(mask.with_voxels(np.asarray(mask.voxels, np.uint8)).on_orthogonal_grid(edges, 0), size / 2)
    inside = depth.voxel_to_world(np.argwhere(np.asarray(depth.voxels) > 0))
    turns = Rotation.concatenate([Rotation.create_group("O"), Rotation.random(TURNS, rng=np.random.default_rng(0))])
    to_centre = inside.mean(axis=0) - centre
    shifts = np.stack([np.zeros(3), to_centre])
    R, t = np.tile(turns.as_matrix(), (2, 1, 1)), np.repeat(shifts, len(turns), axis=0)
    scale = np.full((len(t), 1), np.ptp(y, axis=0).max())
    cloud = _Cloud(y - centre, centre, to_centre)
    modes = _improve(cloud, R, t, scale, depth, FIRST_SHARE, STEPS)
    best = int(modes.evidence.argmax())
    # Neighbours share what the organ deforms.
    share = count_independent(modes.scores[best], modes.places[best]) / len(y)
    modes = _improve(cloud, modes.R, modes.t, modes.scale, depth, share, LAST_STEPS)
    best = int(modes.evidence.argmax())
    distances = np.linalg.norm(modes.places - modes.places[best], axis=2).mean(axis=1)
    is_apart = distances > APART * np.ptp(y, axis=0).max()
    lead = modes.evidence[best] - modes.evidence[is_apart].max() if is_apart.any() else np.inf
    backward = np.eye(4)
    backward[:3, :3], backward[:3, 3] = modes.R[best], centre + modes.t[best] - modes.R[best] @ centre
    return SurfacePose(Pose(backward).inverse, float(lead), len(t))


class _Modes(NamedTuple):
    """The poses to which starts lead.

    Attributes
    ----------
    R, t : (s, 3, 3) and (s, 3) array
        Rotations, and shifts in mm.
    scale : (s, 1) array
        s, mm.
    places : (s, k, 3) array
        The points after the motion, mm.
    scores : (s, k, 3) array
        The gradient of the log density of each point, 1/mm.
    evidence : (s,) array
        log p by Laplace's approximation, up to a constant.
    """

    R: Float[np.ndarray, "starts 3 3"]
    t: Float[np.ndarray, "starts 3"]
    scale: Float[np.ndarray, "starts 1"]
    places: Float[np.ndarray, "starts k 3"]
    scores: Float[np.ndarray, "starts k 3"]
    evidence: Float[np.ndarray, "starts"]


class _Cloud(NamedTuple):
    """Measured points relative to their centre, this centre, and the shift from it to that of the organ, all mm."""

    away: Float[np.ndarray, "k 3"]
    centre: Float[np.ndarray, "3"]
    to_organ: Float[np.ndarray, "3"]


def _improve(
    cloud: _Cloud,
    R: Float[np.ndarray, "starts 3 3"],
    t: Float[np.ndarray, "starts 3"],
    scale: Float[np.ndarray, "starts 1"],
    depth: Image,
    share: float,
    steps: int,
) -> _Modes:
    """Take steps of iteratively reweighted least squares from poses."""
    precision = np.diag(WIDE**-2.0)
    for _ in range(steps):
        turned = np.einsum("sij,kj->ski", R, cloud.away)
        places = turned + (cloud.centre + t)[:, None]
        phi, slope = distance_at(depth, places), slope_at(depth, places)
        weights = (FREEDOM + 1) / (FREEDOM + (phi / scale) ** 2) / scale**2
        J = np.concatenate([slope, np.cross(turned, slope)], axis=2)
        p = np.concatenate([t - cloud.to_organ, Rotation.from_matrix(R).as_rotvec()], axis=1)
        H = share * np.einsum("ska,sk,skb->sab", J, weights, J, optimize=True) + precision
        pull = share * np.einsum("ska,sk->sa", J, weights * phi) + p @ precision
        log = -(FREEDOM + 1) / 2 * np.log1p((phi / scale) ** 2 / FREEDOM) - np.log(scale)
        evidence = share * log.sum(axis=1) - ((p / WIDE) ** 2).sum(axis=1) / 2 - np.linalg.slogdet(H)[1] / 2
        step = np.clip(-np.linalg.solve(H, pull[:, :, None])[:, :, 0], -LONGEST, LONGEST)
        scores = -(weights * phi)[:, :, None] * slope
        modes = _Modes(R, t, scale, places, scores, evidence)
        R, t = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ R, t + step[:, :3]
        # The scale of greatest likelihood, but for the weights.
        scale = np.sqrt((weights * scale**2 * phi**2).mean(axis=1, keepdims=True)) + LEAST_SCALE
    return modes
