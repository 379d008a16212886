"""Rigid motions between the worlds of two images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayesreg.image import Image
from bayesreg.types import AnyArray


class Pose(NamedTuple):
    """How an organ lies in the moving image, beside the fixed one: the rigid part of its displacement.

    Attributes
    ----------
    matrix : (4, 4) array
        World RAS of the fixed image to that of the moving one, mm: a rotation and a translation.
    """

    matrix: AnyArray

    @classmethod
    def identity(cls) -> Pose:
        """As the headers say."""
        return cls(np.eye(4))

    @property
    def is_identity(self) -> bool:
        """Whether it moves nothing."""
        return bool((np.asarray(self.matrix) == np.eye(4)).all())

    @property
    def inverse(self) -> Pose:
        """From the moving world to that of the fixed image."""
        return Pose(np.linalg.inv(np.asarray(self.matrix, float)))

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Its rotation."""
        return np.asarray(self.matrix, float)[:3, :3]

    def place(self, points: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch 3"]:
        """Where points of the fixed world lie in the moving one, mm."""
        return points if self.is_identity else points @ self.rotation.T + np.asarray(self.matrix)[:3, 3]

    def aligned(self, image: Image) -> Image:
        """The moving image laid into the world of the fixed one: its affine changes, and no voxel."""
        return Image(image.voxels, self.inverse.matrix @ image.affine)

    def displacement(
        self, points: Float[AnyArray, "*batch 3"], u: Float[AnyArray, "*batch 3"]
    ) -> Float[AnyArray, "*batch 3"]:
        """From points to where they lie in the moving world, if u takes them to where the aligned image has them."""
        return self.place(points + u) - points

    def about(self, centre: Float[AnyArray, "3"]) -> Motion:
        """The motion as seen from a point of the fixed world."""
        return Motion(self.place(np.asarray(centre)) - centre, Rotation.from_matrix(self.rotation).as_rotvec(True))


class Motion(NamedTuple):
    """A rigid motion as six numbers.

    Attributes
    ----------
    translation : (..., 3) array
        Of the centre, mm, world RAS.
    rotation : (..., 3) array
        About the centre, a vector along its axis, as long as its angle in degrees.
    """

    translation: AnyArray
    rotation: AnyArray

    def pose(self, centre: Float[AnyArray, "3"]) -> Pose:
        """The motion as a pose, the inverse of `Pose.about`; of one motion alone."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(self.rotation, degrees=True).as_matrix()
        matrix[:3, 3] = centre + self.translation - matrix[:3, :3] @ centre
        return Pose(matrix)

    @property
    def millimetres(self) -> float:
        """How far the centre goes."""
        return float(np.linalg.norm(self.translation))

    @property
    def degrees(self) -> float:
        """The angle."""
        return float(np.linalg.norm(self.rotation))


def rigid_projection(
    points: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, "k"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "6 k 3"]]:
    """The weighted centre of points, and what makes of their displacements the small rigid motion nearest to them.

    The motion is a translation, mm, and a rotation about the centre, a vector in radians, to first order: the six
    numbers are the sums of the second array times the displacements.
    """
    centre = np.average(points, axis=0, weights=weights)
    away = points - centre
    turns = np.stack([np.cross(axis, away) for axis in np.eye(3)])
    modes = np.concatenate([np.broadcast_to(np.eye(3)[:, None], turns.shape), turns])
    weighted = modes * weights[:, None]
    projection = np.linalg.solve(np.einsum("aki,bki->ab", weighted, modes), weighted.reshape(6, -1))
    return centre, projection.reshape(weighted.shape)


def compose(pose: Pose, centre: Float[np.ndarray, "3"], small: Float[np.ndarray, "*draws 6"]) -> Motion:
    """Small rigid motions about a centre, then the pose, as motions about that centre.

    Parameters
    ----------
    pose : Pose
    centre : (3,) array
        mm.
    small : (..., 6) array
        Translation, mm, and rotation vector, radians, in the fixed world.

    Returns
    -------
    Motion
        Of (..., 3) arrays.
    """
    small = np.asarray(small, float)
    turned = Rotation.from_matrix(pose.rotation) * Rotation.from_rotvec(small[..., 3:].reshape(-1, 3))
    shifted = pose.place(centre + small[..., :3]) - centre
    return Motion(shifted, turned.as_rotvec(degrees=True).reshape(shifted.shape))
