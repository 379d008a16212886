"""Records of the inputs and the results of a run in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.image import Image, IntensityScale
from bayesreg.mesh import TetMesh
from bayesreg.pose import Pose
from bayesreg.types import AnyArray


class Truth(NamedTuple):
    """The true displacement and parameters of a synthetic pair.

    Attributes
    ----------
    u : (n, 3) array
        True displacement of every node of the run's mesh, mm.
    lam, mu : (T,) array
        True Lamé parameters by tissue.
    initial : (n, 3) array or None
        Centre of the displacements from which the chains started, mm; None for the identity.
    """

    u: AnyArray
    lam: AnyArray
    mu: AnyArray
    initial: AnyArray | None = None


class Predicted(NamedTuple):
    """Predictions from thinned draws, computed at the end of a run because they need the posterior.

    Attributes
    ----------
    chain_mean : (chains, n, 3) array
        Mean displacement of every node for each chain, mm.
    far_mm : scalar
        A distance, mm, for `far`.
    far : (n,) array
        P(|u − ū| > far_mm) at every node, with ū the posterior mean.
    reach : (n,) array
        Radius of the ball around the mean that holds each displaced node with 95 % probability, mm.
    place_names : (L,) array of str
        Names of the points that the report shows.
    place_points : (L, 3) array
        Coordinates of these points in the fixed image's world, mm.
    place_draws : (chains, draws, L, 3) array
        Displacement of these points, mm.
    motion : (chains, draws, 6) array
        The rigid part of the displacement of the whole mesh, including the pose, world RAS: translation of the mesh's
        centre, mm, and the rotation vector about the centre, degrees.
    centre : (3,) array
        The mesh's centre in the fixed image's world, mm.
    observations : mapping
        The arrays of each observation for the report, by "<observation>/<array>".
    evaluation_names, evaluation_points : (k,), (k, 3) arrays or None
        Held-out landmarks: their names, and their coordinates in the fixed image's world, mm.
    evaluation_before, evaluation_posed : (k,) arrays or None
        Distances between the two points of each held-out pair, mm, by the headers and by the pose only.
    evaluation_residual, evaluation_covariance : (k, 3), (k, 3, 3) arrays or None
        The observed point minus its prediction by the posterior mean, mm, in the moving image's world, and the
        covariance of this difference.
    evaluation_inside : (k,) bool array or None
        Whether each held-out landmark lies in the mesh.
    stiffness_mean, stiffness_sd : (m,) array or None
        Posterior mean and standard deviation of the ratio of every element's stiffness to that of its tissue; None
        without a stiffness field.
    stiffer : scalar or None
        A ratio, for `stiffer_probability`.
    stiffer_probability : (m,) array or None
        P(ratio of the element's stiffness to that of its tissue > stiffer).
    """

    chain_mean: AnyArray
    far_mm: AnyArray
    far: AnyArray
    reach: AnyArray
    place_names: np.ndarray
    place_points: AnyArray
    place_draws: AnyArray
    motion: AnyArray
    centre: AnyArray
    observations: Mapping[str, AnyArray] = MappingProxyType({})
    evaluation_names: np.ndarray | None = None
    evaluation_points: AnyArray | None = None
    evaluation_before: AnyArray | None = None
    evaluation_posed: AnyArray | None = None
    evaluation_residual: AnyArray | None = None
    evaluation_covariance: AnyArray | None = None
    evaluation_inside: AnyArray | None = None
    stiffness_mean: AnyArray | None = None
    stiffness_sd: AnyArray | None = None
    stiffer: AnyArray | None = None
    stiffer_probability: AnyArray | None = None

    def of_observation(self, name: str) -> dict[str, AnyArray]:
        """Select the arrays of one observation."""
        return {
            key.removeprefix(f"{name}/"): value
            for key, value in self.observations.items()
            if key.startswith(f"{name}/")
        }

    @property
    def present_entries(self) -> dict[str, AnyArray]:
        """The entries that are not None, without those of observations."""
        return {name: value for name, value in self._asdict().items() if value is not None and name != "observations"}

    def as_arrays(self) -> dict[str, AnyArray]:
        """Collect all entries as named arrays, for files; names of observations' arrays contain a slash."""
        return {**self.present_entries, **self.observations}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, AnyArray]) -> Predicted:
        """Create the record from the arrays of `as_arrays`."""
        entries = {name: value for name, value in arrays.items() if "/" not in name}
        return cls(**entries, observations={name: value for name, value in arrays.items() if "/" in name})

    @property
    def by_cell(self) -> dict[str, AnyArray]:
        """The entries that have one row per element."""
        fields = ("stiffness_mean", "stiffness_sd", "stiffer_probability")
        return {name: value for name, value in self.present_entries.items() if name in fields}


class Matching(NamedTuple):
    """The preparation of the moving image for comparison with the fixed image.

    Attributes
    ----------
    pose : Pose
        The rigid map from the fixed image's world to the moving image's world; its inverse places the moving image in
        the fixed image's world.
    one_contrast : bool
        Whether both images have the same contrast.
    scale : IntensityScale or None
        The scale that maps the moving image's intensities to those of the model; None if no scale was applied.
    in_patches : bool
        Whether the contrasts are related patch by patch only, as those of MRI and ultrasound.
    """

    pose: Pose = Pose.identity()
    one_contrast: bool = True
    scale: IntensityScale | None = None
    in_patches: bool = False

    def as_json(self) -> dict[str, Any]:
        """Convert the record to mappings and lists, for files."""
        pose = np.asarray(self.pose.matrix).tolist()
        return {
            "pose": pose,
            "one_contrast": self.one_contrast,
            "scale": self.scale and list(self.scale),
            "in_patches": self.in_patches,
        }

    @classmethod
    def of_json(cls, mapping: Mapping[str, Any]) -> Matching:
        """Create the record from the mapping of `as_json`."""
        scale = None if mapping["scale"] is None else IntensityScale(*mapping["scale"])
        pose = Pose(np.array(mapping["pose"]))
        return cls(pose, bool(mapping["one_contrast"]), scale, bool(mapping.get("in_patches", False)))


class Channel(NamedTuple):
    """A further pair of images from the same two visits, as the model uses it.

    Attributes
    ----------
    fixed, moving : Image
        The images in the world of the first pair's fixed image, with scaled intensities.
    one_contrast : bool
        Whether both images have the same contrast.
    """

    fixed: Image
    moving: Image
    one_contrast: bool = True


class Inputs(NamedTuple):
    """The inputs of a run, which must not change when the run is resumed.

    Attributes
    ----------
    config : str
        The resolved configuration, YAML.
    mesh : TetMesh
    fixed, moving : Image or None
        The images as the model uses them, in one world and with scaled intensities; None without observed images.
    tissue : Image
        Tissue labels on a grid in the fixed image's world, 0 outside, 1 + index into `mesh.names` inside.
    skull : Image or None
        Nonzero in the region that sampled nodes must not enter.
    truth : Truth or None
    boundary : (b, 3) array or None
        Displacement of the boundary nodes, mm, if it is known and not sampled.
    observed : mapping
        The arrays of each observation by its name, as given, and those of held-out landmarks as "evaluation".
    matching : Matching
    fixed_ignore, moving_ignore : Image or None
        Nonzero where the image of that name is ignored; both in the fixed image's world.
    channels : mapping
        Further pairs of images, by the name of the observation.
    """

    config: str
    mesh: TetMesh
    fixed: Image | None
    moving: Image | None
    tissue: Image
    skull: Image | None = None
    truth: Truth | None = None
    boundary: AnyArray | None = None
    observed: Mapping[str, Mapping[str, np.ndarray]] = MappingProxyType({})
    matching: Matching = Matching()
    fixed_ignore: Image | None = None
    moving_ignore: Image | None = None
    channels: Mapping[str, Channel] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run in memory, without its draws.

    Attributes
    ----------
    config, mesh, fixed, moving, tissue, skull, truth, boundary, observed, matching, fixed_ignore, moving_ignore
    channels
        As in `Inputs`.
    manifest : dict
        The content of run.json.
    u_mean, u_sd : (n, 3) array
        Posterior mean and standard deviation of the displacement of every node, mm.
    warped : Image or None
        The moving image, resampled on the fixed grid by the posterior mean; None without images.
    metrics : dict or None
        The content of metrics.json, if the truth is known.
    predicted : Predicted or None
        The content of predicted.npz; None for a run of a version that did not write this file.
    """

    config: str
    manifest: dict[str, Any]
    mesh: TetMesh
    u_mean: Float[AnyArray, "nodes 3"]
    u_sd: Float[AnyArray, "nodes 3"]
    fixed: Image | None
    moving: Image | None
    tissue: Image
    warped: Image | None
    skull: Image | None = None
    truth: Truth | None = None
    boundary: AnyArray | None = None
    observed: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    matching: Matching = field(default_factory=Matching)
    fixed_ignore: Image | None = None
    moving_ignore: Image | None = None
    channels: Mapping[str, Channel] = field(default_factory=dict)
    metrics: dict[str, Any] | None = None
    predicted: Predicted | None = None

    @property
    def background(self) -> Image:
        """The background image of maps: the fixed image or, without one, the tissue map."""
        return self.tissue if self.fixed is None else self.fixed
