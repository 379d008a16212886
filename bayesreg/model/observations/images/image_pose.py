"""The pose of an organ between two images of any contrast, from several starts.

The measure is that of `linear_combination`: in patches the moving image is linear in f and |∇f|. A patch that explains
nothing, and a place that the moving image does not show, add nothing to the log likelihood. So no pose gains by leaving
the view. With the share κ of points that are independent and a Normal prior of the six motions, a search
leads from each start to a mode of κ log p(f | m) + log p(motion), coarse to fine.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from bayesreg.ignored import fill_ignored, find_filling, ignored_voxels
from bayesreg.image import Image
from bayesreg.interpolation import Interpolator
from bayesreg.model.observations.images.linear_combination import PATCH, PatchRegression, regression_at
from bayesreg.model.observations.images.pointwise import Intensities
from bayesreg.pose import Motion, Pose
from bayesreg.types import AnyArray, InputError, Scalar

# Lengths hold for a human brain, in mm; for other organs they are scaled in proportion.
# The comparison includes the organ's surroundings, such as skull and scalp, up to this distance.
SURROUNDINGS = 15.0
# Rotations about each axis, in degrees, of a head in a scanner or on a table that are tried besides no rotation, and
# the number of starts that are drawn from the prior.
TURNS, DRAWS = (-25.0, 25.0), 300
# For each level: the edge of the voxels and the number of candidates from which it searches.
LEVELS: tuple[tuple[float, int], ...] = ((8.0, 16), (4.0, 4), (2.0, 2))
# The share of the points of one level that are independent: noise and what f does not explain is smoother than a voxel.
INDEPENDENT = 0.1
ITERATIONS = 60
# The greatest number of points of one level.
POINTS = 20_000


class PosePrior(NamedTuple):
    """Normal priors of the six motions about the pose of the headers.

    Attributes
    ----------
    millimetres, degrees : float
        The sd of the displacement of the organ's centre along each axis, and of the rotation about each axis.
    """

    millimetres: float = 10.0
    degrees: float = 10.0

    @property
    def sd(self) -> Float[np.ndarray, "6"]:
        """The sd of the six motions, mm and degrees."""
        return np.repeat([self.millimetres, self.degrees], 3)

    def log(self, motion: Motion) -> float:
        """Return the log density of a motion, up to a constant."""
        shift, turn = motion.translation / self.millimetres, motion.rotation / self.degrees
        return float(-(shift**2).sum() - (turn**2).sum()) / 2


class Candidate(NamedTuple):
    """A pose and what speaks for it.

    Attributes
    ----------
    pose : Pose
    motion : Motion
        The pose as a motion about the organ's centre.
    likelihood : float
        κ log p(f | m) / p(f): nothing in common is 0.
    prior : float
        Log density of the motion, up to a constant.
    seen : float
        The share of the organ that the moving image shows.
    """

    pose: Pose
    motion: Motion
    likelihood: float
    prior: float
    seen: float

    @property
    def evidence(self) -> float:
        """The log posterior density, up to a constant."""
        return self.likelihood + self.prior


# The prior where the headers come from a scanner or from navigation, and where they say nothing about the pose.
USUAL, WIDE = PosePrior(), PosePrior(100.0, 90.0)


class Candidates(NamedTuple):
    """The pose of the headers, the best pose near it, and the best of all poses.

    Attributes
    ----------
    headers, near, best : Candidate
    """

    headers: Candidate
    near: Candidate
    best: Candidate


def find_poses(
    fixed: Image,
    moving: Image,
    organ: Image,
    size: float = 1.0,
    fixed_ignore: Image | None = None,
    moving_ignore: Image | None = None,
    prior: PosePrior = USUAL,
    in_all_directions: bool = False,
) -> Candidates:
    """Find the best pose near that of the headers, and the best pose of all starts.

    Parameters
    ----------
    fixed, moving : Image
    organ : Image
        Nonzero in the organ, on the grid of the fixed image. The comparison includes some millimetres around it.
    size : float
        The size of the organ relative to a human brain.
    fixed_ignore, moving_ignore : Image, optional
        Nonzero where the image of that name is ignored, on any grid in its world.
    prior : PosePrior
    in_all_directions : bool
        Whether starts include the 24 turns by right angles.

    Raises
    ------
    InputError
        If the moving image shows nothing.

    Notes
    -----
    The constant filling around what the moving image shows is ignored, too. The same images give the same pose.
    """
    region = _around(organ, size * SURROUNDINGS)
    if fixed_ignore is not None:
        region = region.with_voxels(np.asarray(region.voxels) * ~ignored_voxels(region, fixed_ignore))
    hidden = find_filling(moving)
    if moving_ignore is not None:
        hidden |= ignored_voxels(moving, moving_ignore)
    if hidden.all():
        raise InputError("the moving image shows nothing: it is constant, or all of it is ignored")
    hidden_mask = moving.with_voxels(hidden.astype(np.uint8))
    fixed, filled = fill_ignored(fixed, fixed_ignore), fill_ignored(moving, hidden_mask)
    centre = centre_of(organ)
    headers = Motion(np.zeros(3), np.zeros(3))
    near, others = headers, list(_starts(fixed, filled, prior, in_all_directions))
    finest = fixed.voxel_volume ** (1 / 3)
    for edge, most in LEVELS:
        level = _Level.of(fixed, filled, region, ~hidden, centre, max(edge * size, finest))
        others.sort(key=lambda motion: level.judge(motion, prior).evidence, reverse=True)
        near, *others = (level.improve(start, prior) for start in (near, *others[:most]))
    candidates = [level.judge(motion, prior) for motion in (near, *others)]
    return Candidates(
        level.judge(headers, prior), candidates[0], max(candidates, key=lambda candidate: candidate.evidence)
    )


def _starts(fixed: Image, moving: Image, prior: PosePrior, in_all_directions: bool) -> Iterator[Motion]:
    """Yield starts: draws from the prior, and motions that match the images by their headers or by their centres.

    The centres are those of the grids and of the mass of the intensities. Each such motion is tried without rotation,
    rotated about each axis and, if asked for, by right angles.
    """
    for draw in np.random.default_rng(0).normal(size=(DRAWS, 6)) * prior.sd:
        yield Motion(draw[:3], draw[3:])
    shifts = [np.zeros(3)]
    for of in (_grid_centre, _mass_centre):
        shifts.append(of(moving) - of(fixed))
    turns = [np.zeros(3)] + [angle * np.eye(3)[axis] for axis, angle in product(range(3), TURNS)]
    if in_all_directions:
        turns += list(Rotation.create_group("O").as_rotvec(degrees=True)[1:])
    for shift, turn in product(shifts, turns):
        yield Motion(shift, turn)


def _around(organ: Image, distance: float) -> Image:
    """Mark the organ and its surroundings up to a distance, mm."""
    away = ndimage.distance_transform_edt(np.asarray(organ.voxels) == 0, organ.voxel_sizes)
    return organ.with_voxels((away <= distance).astype(np.uint8))


def _grid_centre(image: Image) -> Float[np.ndarray, "3"]:
    return image.voxel_to_world((np.array(image.shape) - 1) / 2)


def _mass_centre(image: Image) -> Float[np.ndarray, "3"]:
    voxels = np.asarray(image.voxels, float)
    return image.voxel_to_world(np.array(ndimage.center_of_mass(voxels - voxels.min() + 1e-12)))


def centre_of(mask: Image) -> Float[np.ndarray, "3"]:
    """Return the centre of the nonzero voxels, mm."""
    return mask.voxel_to_world(np.argwhere(np.asarray(mask.voxels) != 0).mean(axis=0))


class _Level(NamedTuple):
    """Both images at one resolution (a pytree).

    Attributes
    ----------
    positions : (q, 3) array
        Relative to the centre, mm.
    centre : (3,) array
    radius : scalar
        The root mean square distance of the positions from the centre, mm.
    moving, visible : Interpolator
    regression : PatchRegression
    """

    positions: Float[AnyArray, "points 3"]
    centre: Float[AnyArray, "3"]
    radius: Scalar
    moving: Interpolator
    visible: Interpolator
    regression: PatchRegression

    @classmethod
    def of(
        cls, fixed: Image, moving: Image, region: Image, shown: np.ndarray, centre: Float[np.ndarray, "3"], edge: float
    ) -> _Level:
        coarse = region.on_orthogonal_grid(np.maximum(region.voxel_sizes, edge), 0)
        voxels = np.random.default_rng(0).permutation(np.argwhere(np.asarray(coarse.voxels) != 0))[:POINTS]
        positions = coarse.voxel_to_world(voxels.astype(float))
        smooth = moving.smoothed(edge / 2)
        regression = regression_at(
            positions, fixed.smoothed(edge / 2).interpolator("cubic"), PATCH * edge / 2, smooth.voxels[shown].var()
        )
        # Nothing is seen beyond the grid.
        affine = np.array(moving.affine, float)
        affine[:3, 3] = moving.voxel_to_world(-np.ones(3))
        visible = Image(np.pad(shown.astype(float), 1), affine).interpolator("linear")
        away = positions - centre
        radius = jnp.sqrt((away**2).sum(axis=1).mean())
        return cls(jnp.asarray(away), jnp.asarray(centre), radius, smooth.interpolator("cubic"), visible, regression)

    def improve(self, start: Motion, prior: PosePrior) -> Motion:
        """Find the mode near a start."""
        unit = np.repeat([1.0, np.degrees(1.0) / float(self.radius)], 3)
        sd = prior.sd

        def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = _minus_log_likelihood(self, x * unit)
            return float(value) + ((x * unit / sd) ** 2).sum() / 2, np.asarray(slope) * unit + x * (unit / sd) ** 2

        x = (
            minimize(loss, np.concatenate(start) / unit, jac=True, method="L-BFGS-B", options={"maxiter": ITERATIONS}).x
            * unit
        )
        return Motion(x[:3], x[3:])

    def judge(self, motion: Motion, prior: PosePrior) -> Candidate:
        """Return the candidate at a motion."""
        x = jnp.concatenate([jnp.asarray(motion.translation), jnp.asarray(motion.rotation)])
        value, _ = _minus_log_likelihood(self, x)
        seen = float(self.visible(_places(self, x)).mean())
        pose = motion.pose(np.asarray(self.centre))
        return Candidate(pose, motion, -float(value), prior.log(motion), seen)


def _places(level: _Level, motion: Float[AnyArray, "6"]) -> Float[AnyArray, "points 3"]:
    """Return the moved points, mm."""
    x, y, z = jnp.radians(motion[3:])
    zero = jnp.zeros(())
    turn = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return level.centre + motion[:3] + level.positions @ jax.scipy.linalg.expm(turn).T


@jax.jit
@partial(jax.value_and_grad, argnums=1)
def _minus_log_likelihood(level: _Level, motion: Float[AnyArray, "6"]) -> Scalar:
    places = _places(level, motion)
    weights = jnp.ones(len(places))
    values = Intensities(level.regression.functions[:, 0], level.moving(places), weights, level.visible(places))
    return INDEPENDENT * level.regression.energy(values, level.regression.temperature)
