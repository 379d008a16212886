"""The inputs and the results of a run, in memory."""

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
    """The truth of a synthetic pair.

    Attributes
    ----------
    u : (n, 3) array
        True displacement of every node of the run's mesh, mm.
    lam, mu : (T,) array
        True Lamé parameters by tissue.
    initial : (n, 3) array or None
        Centre of the displacements that the chains started from, mm; None for the identity.
    """

    u: AnyArray
    lam: AnyArray
    mu: AnyArray
    initial: AnyArray | None = None


class Predicted(NamedTuple):
    """Predictions of thinned draws, computed at the end of a run, since they need the posterior itself.

    Attributes
    ----------
    chain_mean : (chains, n, 3) array
        Mean displacement of every node, mm, chain by chain.
    far_mm : scalar
    far : (n,) array
        P(|u − ū| > far_mm) at every node, ū the posterior mean, what the mesh cannot follow included.
    reach : (n,) array
        Within which a point at each node lies about its mean place with 95 %, mm; in the same way.
    place_names : (L,) array of str
    place_points : (L, 3) array
        World mm, in the fixed image.
    place_draws : (chains, draws, L, 3) array
        Displacement of the places, mm.
    motion : (chains, draws, 6) array
        The rigid part of the displacement of the whole mesh, the pose included: translation of its centre, mm, and
        rotation about it, a vector in degrees, world RAS.
    centre : (3,) array
        That centre, mm, in the fixed image.
    total_sd : (n, 3) array or None
        Standard deviation of the displacement of every node along the axes of the moving image's world, mm; None where
        there is no pose, and these axes are those of the fixed image.
    observations : mapping
        What each observation leaves for the report, by "<observation>/<array>".
    evaluation_names, evaluation_points : (k,), (k, 3) arrays or None
        Landmarks that were held out: names, and places in the fixed image.
    evaluation_before, evaluation_posed : (k,) arrays or None
        Their distances, mm, by the headers and by the pose alone.
    evaluation_residual, evaluation_covariance : (k, 3), (k, 3, 3) arrays or None
        Found less predicted by the posterior mean, mm, in the moving image's world, and the covariance of that.
    evaluation_inside : (k,) bool array or None
        Which lie in the mesh.
    stiffness_mean, stiffness_sd : (m,) array or None
        Posterior mean and standard deviation of every element's stiffness over its tissue's; None without a field.
    stiffer : scalar or None
    stiffer_probability : (m,) array or None
        P(stiffness over the tissue's > stiffer).
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
    total_sd: AnyArray | None = None
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
        """What the observation of this name has left."""
        return {
            key.removeprefix(f"{name}/"): value
            for key, value in self.observations.items()
            if key.startswith(f"{name}/")
        }

    @property
    def known(self) -> dict[str, AnyArray]:
        """The entries that there are."""
        return {name: value for name, value in self._asdict().items() if value is not None and name != "observations"}

    def as_arrays(self) -> dict[str, AnyArray]:
        """All entries as named arrays, for files; those of observations have a slash in their names."""
        return {**self.known, **self.observations}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, AnyArray]) -> Predicted:
        """What `as_arrays` made."""
        own = {name: value for name, value in arrays.items() if "/" not in name}
        return cls(**own, observations={name: value for name, value in arrays.items() if "/" in name})

    @property
    def by_cell(self) -> dict[str, AnyArray]:
        """The entries that have one row per element."""
        fields = ("stiffness_mean", "stiffness_sd", "stiffer_probability")
        return {name: value for name, value in self.known.items() if name in fields}


class Matching(NamedTuple):
    """How the moving image was brought beside the fixed one before the model saw it.

    Attributes
    ----------
    pose : Pose
        The moving image lies in the world of the fixed one by its inverse.
    one_contrast : bool
        Whether the intensities of both mean the same.
    scale : IntensityScale or None
        That of the moving image as the model sees it; None where it was made so.
    """

    pose: Pose = Pose.identity()
    one_contrast: bool = True
    scale: IntensityScale | None = None

    def as_json(self) -> dict[str, Any]:
        """As mappings and lists, for files."""
        pose = np.asarray(self.pose.matrix).tolist()
        return {"pose": pose, "one_contrast": self.one_contrast, "scale": self.scale and list(self.scale)}

    @classmethod
    def of_json(cls, given: Mapping[str, Any]) -> Matching:
        """What `as_json` made."""
        scale = None if given["scale"] is None else IntensityScale(*given["scale"])
        return cls(Pose(np.array(given["pose"])), bool(given["one_contrast"]), scale)


class Channel(NamedTuple):
    """A further pair of images of the same two visits, as the model sees it.

    Attributes
    ----------
    fixed, moving : Image
        In the world of the fixed image of the first pair, on their scales of intensities.
    one_contrast : bool
        Whether the intensities of both mean the same.
    """

    fixed: Image
    moving: Image
    one_contrast: bool = True


class Inputs(NamedTuple):
    """The inputs of a run, which a resumed run must find unchanged.

    Attributes
    ----------
    config : str
        The resolved configuration, YAML.
    mesh : TetMesh
    fixed, moving : Image or None
        As the model saw them, in one world and on their scales of intensities; None where no images were observed.
    tissue : Image
        Tissue labels on a grid of the fixed space, 0 outside, 1 + index into `mesh.names` inside.
    skull : Image or None
        Nonzero where no sampled node may go.
    truth : Truth or None
    boundary : (b, 3) array or None
        Displacement of the boundary nodes, mm, where it is known and not sampled.
    observed : mapping
        Arrays that were read for each observation, by its name, and those of landmarks that were held out, as
        "evaluation"; as they were given.
    matching : Matching
    fixed_ignore, moving_ignore : Image or None
        Not zero where the image of that name says nothing, each in the world of the fixed image.
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
    """A finished run in memory; its draws travel beside it.

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
        Moving image resampled on the fixed grid by the posterior mean; None without images.
    metrics : dict or None
        The content of metrics.json, where the truth is known.
    predicted : Predicted or None
        The content of predicted.npz; None for runs of versions that wrote none.
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
        """The image that maps are drawn on: the fixed one, or where there is none the tissue map."""
        return self.tissue if self.fixed is None else self.fixed
