"""Represent rigid motions between the worlds of two images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayesreg.image import Image
from bayesreg.types import AnyArray


class Pose(NamedTuple):
    """The rigid part of an organ's displacement from the fixed to the moving image.

    Attributes
    ----------
    matrix : (4, 4) array
        Maps world RAS of the fixed image to world RAS of the moving image, mm: a rotation and a translation.
    """

    matrix: AnyArray

    @classmethod
    def identity(cls) -> Pose:
        """Make the pose that moves nothing: the headers of both images are right."""
        return cls(np.eye(4))

    @property
    def is_identity(self) -> bool:
        """Whether the pose moves nothing."""
        return bool((np.asarray(self.matrix) == np.eye(4)).all())

    @property
    def inverse(self) -> Pose:
        """The pose from the world of the moving image to the world of the fixed image."""
        return Pose(np.linalg.inv(np.asarray(self.matrix, float)))

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The rotation matrix of the pose."""
        return np.asarray(self.matrix, float)[:3, :3]

    def place(self, points: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch 3"]:
        """Map points from the world of the fixed image to the world of the moving image, mm."""
        return points if self.is_identity else points @ self.rotation.T + np.asarray(self.matrix)[:3, 3]

    def aligned(self, image: Image) -> Image:
        """Place the moving image in the world of the fixed image: its affine changes, its voxels do not."""
        return Image(image.voxels, self.inverse.matrix @ image.affine)

    def displacement(
        self, points: Float[AnyArray, "*batch 3"], u: Float[AnyArray, "*batch 3"]
    ) -> Float[AnyArray, "*batch 3"]:
        """Compute the displacement of points by u, which leads to the aligned image, followed by the pose."""
        return self.place(points + u) - points

    def about(self, centre: Float[AnyArray, "3"]) -> Motion:
        """Express the pose as a motion about a point of the fixed image's world."""
        return Motion(self.place(np.asarray(centre)) - centre, Rotation.from_matrix(self.rotation).as_rotvec(True))


class Motion(NamedTuple):
    """A rigid motion about a centre, as six numbers.

    Attributes
    ----------
    translation : (..., 3) array
        The displacement of the centre, mm, world RAS.
    rotation : (..., 3) array
        The rotation vector about the centre; it points along the axis, and its length is the angle in degrees.
    """

    translation: AnyArray
    rotation: AnyArray

    def pose(self, centre: Float[AnyArray, "3"]) -> Pose:
        """Convert a single motion to a pose; the inverse of `Pose.about`."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(self.rotation, degrees=True).as_matrix()
        matrix[:3, 3] = centre + self.translation - matrix[:3, :3] @ centre
        return Pose(matrix)

    @property
    def millimetres(self) -> float:
        """The length of the centre's displacement, mm."""
        return float(np.linalg.norm(self.translation))

    @property
    def degrees(self) -> float:
        """The angle of the rotation, in degrees."""
        return float(np.linalg.norm(self.rotation))


def rigid_projection(
    points: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, "k"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "6 k 3"]]:
    """Return the weighted centre of points, and the projection of their displacements onto small rigid motions.

    The motion nearest to the displacements is a translation, mm, and a rotation about the centre, a vector in radians,
    to first order. Its six numbers are the sums, over points and axes, of the projection times the displacements.
    """
    centre = np.average(points, axis=0, weights=weights)
    away = points - centre
    turns = np.stack([np.cross(axis, away) for axis in np.eye(3)])
    modes = np.concatenate([np.broadcast_to(np.eye(3)[:, None], turns.shape), turns])
    weighted = modes * weights[:, None]
    projection = np.linalg.solve(np.einsum("aki,bki->ab", weighted, modes), weighted.reshape(6, -1))
    return centre, projection.reshape(weighted.shape)


def compose(pose: Pose, centre: Float[np.ndarray, "3"], small: Float[np.ndarray, "*draws 6"]) -> Motion:
    """Compose small rigid motions about a centre with the pose that follows them, as motions about this centre.

    Parameters
    ----------
    pose : Pose
    centre : (3,) array
        The centre in the world of the fixed image, mm.
    small : (..., 6) array
        Translation, mm, and rotation vector, radians, in the world of the fixed image.

    Returns
    -------
    Motion
        The composed motions, as (..., 3) arrays.
    """
    small = np.asarray(small, float)
    turned = Rotation.from_matrix(pose.rotation) * Rotation.from_rotvec(small[..., 3:].reshape(-1, 3))
    shifted = pose.place(centre + small[..., :3]) - centre
    return Motion(shifted, turned.as_rotvec(degrees=True).reshape(shifted.shape))
