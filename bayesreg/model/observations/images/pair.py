"""A pair of images in the form that a user gives."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import ValidationError

from bayesreg.ignored import fill_ignored
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.observations.images.contrast import map_contrast
from bayesreg.model.observations.images.options import PRESETS, ImageOptions, with_preset
from bayesreg.model.observations.images.prepared import MappedPair, PreparedPair, describe_pair
from bayesreg.model.observations.observation import Placed
from bayesreg.types import InputError


class ImagePair:
    """A pair of images: one shows the organ before, the other after its deformation.

    Parameters
    ----------
    fixed, moving : Image
        f and m; their intensities are not rescaled.
    name : str, default "images"
        The name of the pair in tables and in the NumPyro program.
    fixed_ignore : Image, optional
        Nonzero where the fixed image is ignored: no point is compared there. On any grid, in the world of f.
    moving_ignore : Image, optional
        Nonzero where the moving image is ignored, such as in a cavity: a point displaced into it may have any
        intensity of the organ. On any grid, in the world of m.
    one_contrast : bool, default True
        False: f is compared through the best map of its intensities to those of m (see `contrast`).
    tissue : Image, optional
        Labels on the grid of the fixed image, 0 outside: that map then differs between tissues.
    **options
        How the images are compared, as in `ImageOptions`: similarity (`SquaredDifferences`, `StudentT`,
        `LocalCorrelation`, `MutualInformation` or `SelfSimilarity`), interpolation, quadrature, most_points, smoothing,
        intensity_map, independent_points. The preset of the model gives all other options.

    Raises
    ------
    InputError
        If an argument is not an image, `tissue` lies on another grid, or an option does not exist or is wrong.

    Notes
    -----
    The temperature T_s is the block "t_similarity" of a pair named "images", and "<name>_t_similarity" of another one.
    """

    def __init__(
        self,
        fixed: Image,
        moving: Image,
        name: str = "images",
        fixed_ignore: Image | None = None,
        moving_ignore: Image | None = None,
        one_contrast: bool = True,
        tissue: Image | None = None,
        **options: Any,
    ) -> None:
        for which, image in (("fixed", fixed), ("moving", moving)):
            if not isinstance(image, Image):
                raise InputError(f"{name}: {which} must be an Image, got {type(image).__name__}; see load_image")
        for which, mask in (("fixed_ignore", fixed_ignore), ("moving_ignore", moving_ignore)):
            if not isinstance(mask, Image | None):
                raise InputError(f"{name}: {which} must be an Image, got {type(mask).__name__}; see load_image")
        if tissue is not None and not (
            tissue.shape == fixed.shape and np.allclose(tissue.affine, fixed.affine, atol=1e-3)
        ):
            raise InputError(f"{name}: tissue must lie on the grid of the fixed image, and lies on another")
        self.fixed, self.moving, self.name = fixed, moving, name
        self.fixed_ignore, self.moving_ignore = fixed_ignore, moving_ignore
        self.one_contrast, self.tissue, self.options = one_contrast, tissue, dict(options)
        _require_options(name, self.options)

    def prepared(self, mesh: TetMesh, preset: str = "paper") -> PreparedPair:
        """Prepare the pair for comparison: convert f to the contrast of m by a map at rest, or compute descriptors.

        Ignored voxels are filled with the values beside them.

        Parameters
        ----------
        mesh : TetMesh
        preset : {"paper", "registration"}
            The preset of the model, which completes the options.

        Raises
        ------
        InputError
            As `on`.
        """
        fixed, moving = fill_ignored(self.fixed, self.fixed_ignore), fill_ignored(self.moving, self.moving_ignore)
        options = _options_of(self.name, preset, self.options)
        pair = PreparedPair(fixed, moving, self.name, self.fixed_ignore, self.moving_ignore, options)
        if options.similarity.compares_descriptors:
            return describe_pair(pair)
        if self.one_contrast or options.similarity.serves_any_contrast:
            return pair
        positions = pair.compared_points(mesh).positions(mesh)
        mapped = map_contrast(fixed, moving, positions, self.tissue)
        return MappedPair(mapped, moving, self.name, self.fixed_ignore, self.moving_ignore, options, fixed, self.tissue)

    def on(self, mesh: TetMesh, preset: str = "paper") -> Placed:
        """Place the pair on a mesh, with its own T_s.

        Raises
        ------
        InputError
            If the mesh does not overlap an image, or the quadrature has no points or fewer than are independent.
        """
        return self.prepared(mesh, preset).on(mesh)


def _require_options(name: str, options: dict[str, Any]) -> None:
    """Raise InputError if options are wrong for every preset; the preset of the model is not known yet."""
    errors = []
    for preset in PRESETS:
        try:
            _options_of(name, preset, options)
        except InputError as error:
            errors.append(error)
    if len(errors) == len(PRESETS):
        raise errors[0]


def _options_of(name: str, preset: str, options: dict[str, Any]) -> ImageOptions:
    try:
        return ImageOptions(**with_preset(preset, options))
    except ValidationError as error:
        details = error.errors(include_url=False)[0]
        key = ".".join(map(str, details["loc"])) or str(details.get("ctx", {}).get("key", "options"))
        raise InputError(f"{name}: {key}: {details['msg']}") from None
