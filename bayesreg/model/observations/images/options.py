"""The options of the comparison of a pair of images, and their values in each preset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from bayesreg.interpolation import Interpolation
from bayesreg.model.observations.images.pointwise import SimilaritySettings, SquaredDifferences
from bayesreg.model.observations.images.similarity import SIMILARITIES, AnySimilarity
from bayesreg.settings import NotNegative, Positive, Section, by_kind, wrong

# The kinds of similarities that include a map of intensities.
OF_ANY_CONTRAST = [kind for kind, similarity in SIMILARITIES.items() if similarity.serves_any_contrast]

# Defaults by the name of the model's preset. The options of "paper" are the defaults of `ImageOptions`.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "registration": {
        "similarity": {"kind": "student_t", "temperature": {"median": 0.05, "log_sd": 3.0}},
        "interpolation": "cubic",
        "quadrature": "voxels",
        "most_points": 100_000,
        "independent_points": "residual",
        "smoothing": 0.8,
        "intensity_map": 2,
    },
}


class ImageOptions(Section):
    """The options of the comparison of two images."""

    similarity: Annotated[AnySimilarity, Field(discriminator="kind"), BeforeValidator(by_kind)] = SquaredDifferences()
    """The similarity, and with it the noise and its temperature T_s: ssd, student_t, or for images of unlike contrast
    lc2 (ultrasound), lncc, mi or mind."""
    interpolation: Interpolation = "linear"
    """Interpolation of the images; cubic where gradients are used."""
    quadrature: Literal["gauss4", "gauss32", "gauss256", "voxels"] = "gauss4"
    """Points of the integral in eq. (1): 4, 32 or 256 for each tetrahedron, or the fixed image's voxel centres inside
    the mesh."""
    most_points: Annotated[int, Field(strict=True, ge=1)] | None = None
    """With voxels: where there are more, a fixed random choice of so many of them."""
    smoothing: NotNegative = 0.0
    """Standard deviation, in voxels of the coarser image, of a Gaussian that both images are smoothed with. Between
    voxel centres interpolation averages the noise of m, and at them it does not: without smoothing that draws
    displacements towards half voxels."""
    intensity_map: Annotated[int, Field(strict=True, ge=0, le=6)] | None = None
    """Where the intensities of both images differ by a slow shading: f is compared with m less a polynomial of this
    degree in x, times f, and less a constant, whose coefficients are inferred. 0 is a gain and an offset."""
    independent_points: Positive | Literal["residual"] | None = None
    """Effective number of independent quadrature points: the log likelihood is tempered by its share of all of them.
    null: all are independent. residual: as many as the correlation of the residuals tells near the mode, which sampling
    estimates before all else; with voxels."""

    @model_validator(mode="after")
    def _agree(self) -> ImageOptions:
        kind = self.similarity.kind
        if self.intensity_map is not None and self.similarity.serves_any_contrast:
            raise wrong("intensity_map", f"expected null with similarity: {kind}, which has maps of its own")
        if self.independent_points == "residual" and self.quadrature != "voxels":
            raise wrong("independent_points", f"residual needs quadrature: voxels, which is {self.quadrature} here")
        return self


def with_preset(preset: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the given options, completed by the options of a preset that are compatible with them."""
    chosen = dict(PRESETS[preset])
    if options.get("quadrature", "voxels") != "voxels":
        chosen = {name: value for name, value in chosen.items() if name not in ("most_points", "independent_points")}
    if "similarity" in options:
        usual = chosen.pop("similarity", {"kind": "ssd"})
        similarity = by_kind(options["similarity"])
        if isinstance(similarity, SimilaritySettings):
            similarity = {"kind": similarity.kind, **similarity.model_dump(exclude_unset=True)}
        if isinstance(similarity, Mapping):
            kind = similarity.get("kind", usual["kind"])
            if kind in OF_ANY_CONTRAST:
                chosen.pop("intensity_map", None)
            # These have no noise to infer from all points together.
            temperature = {} if kind in ("mi", "lc2") else {key: usual[key] for key in ("temperature",) if key in usual}
            options = {**options, "similarity": {"kind": kind, **temperature, **similarity}}
    return {**chosen, **options}
