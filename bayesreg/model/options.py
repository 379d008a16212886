"""The options of a registration model, as a validated, immutable record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, StrictBool, model_validator
from pydantic_core import PydanticCustomError

from bayesreg.tissues import tissue_of_unit_mu
from bayesreg.types import InputError

# Names of blocks and of the other sites of the program, which no observation may have.
TAKEN = (
    "u_boundary", "lam", "mu", "t_similarity", "t_elastic", "body_load", "surface_load", "field", "field_sd", "elastic",
    "rigid", "skull", "barrier", "support", "solved", "u", "strain_energy", "similarity_energy", "solver_iterations",
    "solver_failed", "outside_support", "evaluation",
)  # fmt: skip

# Options that say how images are compared.
OF_IMAGES = (
    "similarity", "window_mm", "degrees_of_freedom", "independent_points", "t_similarity", "interpolation",
    "quadrature", "most_points", "smoothing", "intensity_map",
)  # fmt: skip

# Similarities that bring a map of intensities of their own.
OF_ANY_CONTRAST = ("lncc", "mi", "mind")

Lame = Literal["lam", "mu"]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]


class PriorConfig(BaseModel):
    """Beta prior scaled to [low, high]; with high = ∞ the flat improper prior on [low, ∞).

    Attributes
    ----------
    alpha, beta : float
        Shape parameters A and B, positive; 1 and 1 is flat.
    low, high : float
        r1 and r2, in the unit of the parameter (relative, or kPa), 0 ≤ low < high.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    alpha: Positive = 1.0
    beta: Positive = 1.0
    low: Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)] = 0.0
    high: Annotated[float, Field(strict=True, allow_inf_nan=True)] = math.inf

    @model_validator(mode="after")
    def _range(self) -> PriorConfig:
        if not self.low < self.high:
            raise ValueError(f"a prior needs low < high (r1 < r2), got low = {self.low}, high = {self.high}")
        if math.isinf(self.high) and (self.alpha, self.beta) != (1.0, 1.0):
            raise ValueError(
                f"high = inf is the flat prior and needs alpha = beta = 1, got {self.alpha} and {self.beta}; "
                "give a finite high for a Beta prior"
            )
        return self


class ScalePrior(BaseModel):
    """Log-normal prior of a positive number, such as the standard deviation of an error.

    Attributes
    ----------
    median : float
        In the unit of the number, positive.
    log_sd : float
        Standard deviation of its natural logarithm, positive; 1 spans a factor of 50 with 95 %.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    median: Positive
    log_sd: Positive = 1.0


class TemperaturePrior(ScalePrior):
    """Log-normal prior of a Boltzmann temperature."""


class FieldConfig(BaseModel):
    """Prior of the field of log-stiffness of `elasticity: field`; see `bayesreg.model.field`.

    Attributes
    ----------
    correlation : float
        Distance, mm, at which the correlation of the log-stiffness of two places has fallen to 0.14.
    sd : float
        Scale of the half-normal prior of the field's standard deviation, which is inferred; 0.5 is a factor of e^0.5.
    modes : int
        Most principal components of the field that are sampled.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    correlation: Positive = 20.0
    sd: Positive = 0.5
    modes: Annotated[int, Field(strict=True, ge=1)] = 300


# Options by the name of a preset; what else is given replaces them.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "registration": {
        "elastic_prior": "loads",
        "body_load": {"median": 0.1, "log_sd": 3.0},
        "surface_load": {"median": 0.1, "log_sd": 3.0},
        "normalised": True,
        "sampled": "all",
        "priors": {"lam": {"high": 100.0}, "mu": {"high": 20.0}},
        "similarity": "student_t",
        "t_similarity": {"median": 0.05, "log_sd": 3.0},
        "interpolation": "cubic",
        "quadrature": "voxels",
        "most_points": 100_000,
        "independent_points": "residual",
        "smoothing": 0.8,
        "intensity_map": 2,
        "least_volume": 0.1,
    },
}


class ModelConfig(BaseModel):
    """The posterior to sample; the defaults are the paper's.

    Attributes
    ----------
    preset : {"paper", "registration"}
        The options that are not given: the paper's, or those of `PRESETS` for pairs of images that no model made.
    elasticity : {"tissue", "uniform", "element", "field"}
        One pair (λ, μ) for each tissue, one for all, one for each tetrahedron; or one for each tissue, times the
        exponential of a smooth random field over its tetrahedra.
    field : FieldConfig, optional
        Prior of that field; for "field" alone.
    fixed : mapping, optional
        Parameters that are known: ``{"mu": {"liver": 1.0}}`` by tissue name (by element it fixes every
        element of that tissue), or ``{"mu": 1.0}`` for all entries of μ. The default fixes μ of one tissue
        (`bayesreg.tissues.tissue_of_unit_mu`) at 1, uniform: μ at 1; the scale of λ, μ is not identified otherwise.
    priors : mapping
        A prior for each of "lam", "mu", or one for each tissue: ``{"lam": {"liver": PriorConfig(high=60)}}``;
        what is not named has the flat prior on [0, ∞).
    similarity : {"ssd", "student_t", "lncc", "mi", "mind"}
        Sum of squared differences, eq. (1): Gaussian noise; Student's t noise, which forgives outliers; or, for images
        of unlike contrast, squared differences after the best affine map of intensities in each of many windows
        (`bayesreg.model.local_correlation`), mutual information (`bayesreg.model.mutual_information`), whose
        t_similarity is no noise, but a temperature of the likelihood alone, or squared differences of what places look
        like beside their neighbours (`bayesreg.model.self_similarity`).
    degrees_of_freedom : float
        ν of "student_t", above 2: the fewer, the heavier the tails; many are Gaussian.
    window_mm : float
        Longest side of a window of "lncc", mm, within which one affine map should relate the contrasts. Where the
        quadrature has few points, windows are as much larger as to hold 16.
    independent_points : float or "residual", optional
        Effective number of independent quadrature points: the log likelihood is tempered by its share of all of them.
        None: all are independent. "residual": as many as the correlation of the residuals tells near the mode
        (`bayesreg.model.independence`); for `quadrature: voxels`. Sampling estimates it before all else.
    t_similarity, t_elastic : float or TemperaturePrior
        Boltzmann temperatures T_s (mm³ times squared intensity) and T_r (energy), known or inferred.
    elastic_prior : {"boltzmann", "loads"}
        exp(−E_r / T_r), eq. (12); or equilibrium with random loads, K u = q in place of eq. (7), of all nodes, which
        depends much less on the mesh (`bayesreg.model.terms.elastic`). The latter needs `sampled: all` and `normalised:
        true`, and has no T_r.
    body_load, surface_load : float or ScalePrior, optional
        Standard deviations of the white noise of body forces (unit of μ times mm^½) and of surface forces (unit of μ
        times mm), known or inferred; for "loads" alone.
    normalised : bool
        False: the paper's density, without the normaliser of the elastic prior in λ, μ. True: with it; then
        every free λ, μ needs a prior with a finite `high`, and `fixed: {}` lets all be free if T_r is known.
    interpolation : {"linear", "cubic"}
        Interpolation of the images; cubic where gradients are used.
    quadrature : {"gauss4", "gauss32", "gauss256", "voxels"}
        Points of the integral in eq. (1): 4, 32 or 256 for each tetrahedron, or the fixed image's voxel
        centres inside the mesh.
    most_points : int, optional
        With "voxels": where there are more, a fixed random choice of so many of them.
    smoothing : float
        Standard deviation, in voxels of the coarser image, of a Gaussian that both images are smoothed with. Between
        voxel centres interpolation averages the noise of m, and at them it does not: without smoothing that draws
        displacements towards half voxels.
    intensity_map : int, optional
        Where the intensities of both images differ by a slow shading: f is compared with m less a polynomial of this
        degree in x, times f, and less a constant, whose coefficients are inferred. 0 is a gain and an offset.
    sampled : "boundary", "all" or list of int
        Nodes whose displacements are sampled; the others follow by the elastic solve.
    held : mapping of int to (x, y, z)
        Nodes with a known displacement, mm; they are not sampled. Elastography: all boundary nodes held and
        ``sampled=[]``; only λ, μ are then sampled, and E_r, the prior of u_B, is no part of the density.
    skull_width : float
        Depth inside the skull, in voxels of its mask, that counts as one standard deviation: masks are no better known
        than half a voxel. 0: no sampled node lies in the skull, as in the paper; for the sampler rwmh alone, since no
        gradient tells of such a wall.
    least_volume : float
        0: tetrahedra may be inverted. Else a barrier, which begins where a tetrahedron is left with less than this
        share of its volume (`bayesreg.model.terms.barrier`). Like the skull it has no part in the normaliser.
    rigid_sd : float, optional
        Standard deviation, mm, of the root-mean-square displacement of each of the six rigid motions of
        the sampled nodes under a Gaussian prior; None is flat.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Literal["paper", "registration"] = "paper"
    elasticity: Literal["tissue", "uniform", "element", "field"] = "tissue"
    field: FieldConfig | None = None
    fixed: dict[Lame, Positive | dict[str, Positive]] | None = None
    priors: dict[Lame, PriorConfig | dict[str, PriorConfig]] = {}
    similarity: Literal["ssd", "student_t", "lncc", "mi", "mind"] = "ssd"
    window_mm: Positive = 10.0
    degrees_of_freedom: Annotated[float, Field(strict=True, gt=2, allow_inf_nan=False)] = 4.0
    independent_points: Positive | Literal["residual"] | None = None
    t_similarity: Positive | TemperaturePrior = 0.05
    t_elastic: Positive | TemperaturePrior = 1e4
    elastic_prior: Literal["boltzmann", "loads"] = "boltzmann"
    body_load: Positive | ScalePrior | None = None
    surface_load: Positive | ScalePrior | None = None
    normalised: StrictBool = False
    interpolation: Literal["linear", "cubic"] = "linear"
    quadrature: Literal["gauss4", "gauss32", "gauss256", "voxels"] = "gauss4"
    most_points: Annotated[int, Field(strict=True, ge=1)] | None = None
    smoothing: Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)] = 0.0
    intensity_map: Annotated[int, Field(strict=True, ge=0, le=6)] | None = None
    sampled: Literal["boundary", "all"] | list[Annotated[int, Field(ge=0)]] = "boundary"
    held: dict[Annotated[int, Field(ge=0)], Vector] = {}
    skull_width: Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)] = 0.5
    least_volume: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    rigid_sd: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _take_over_preset(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        chosen = dict(PRESETS.get(str(given.get("preset")), {}))
        if given.get("similarity") in OF_ANY_CONTRAST:
            chosen.pop("intensity_map", None)
        if given.get("similarity") == "mi":
            # There is no noise to infer.
            chosen.pop("t_similarity", None)
        return {**chosen, **given}

    @model_validator(mode="after")
    def _is_proper(self) -> ModelConfig:
        if self.field is not None and self.elasticity != "field":
            raise wrong("field", f"expected null: it belongs to elasticity: field, which is {self.elasticity} here")
        if self.intensity_map is not None and self.similarity in OF_ANY_CONTRAST:
            raise wrong("intensity_map", f"expected null with similarity: {self.similarity}, which has maps of its own")
        if isinstance(self.t_similarity, TemperaturePrior) and self.similarity == "mi":
            raise wrong("t_similarity", "expected a number with similarity: mi, which knows no noise to infer")
        if self.independent_points == "residual" and self.quadrature != "voxels":
            raise wrong("independent_points", f"residual needs quadrature: voxels, which is {self.quadrature} here")
        if self.elastic_prior == "loads":
            self._require_random_loads()
        elif (self.body_load, self.surface_load) != (None, None):
            raise wrong("body_load", "expected null, as surface_load: they belong to elastic_prior: loads")
        if isinstance(self.t_elastic, TemperaturePrior) and not self.normalised:
            raise wrong("t_elastic", "a T_r with a prior needs normalised: true; without it T_r has no likelihood")
        if isinstance(self.t_elastic, TemperaturePrior) and self.fixed is not None and not any(self.fixed.values()):
            raise wrong(
                "fixed",
                "t_elastic has a prior and no λ or μ is known: their common scale and T_r cannot be told apart; "
                "fix one parameter or t_elastic",
            )
        if self.normalised:
            if self.is_elastography:
                raise wrong("normalised", "expected false where no node is sampled: a given u_B has no prior")
            self._require_rest()
        if self.normalised or self.is_elastography:
            # Where the options name no tissue, the mesh has one at least, which is free or known as `known` says.
            self.require_proper_priors(self._named_tissues or ("the tissue",))
        return self

    def _require_random_loads(self) -> None:
        """Refuse what the prior of random loads leaves no room for."""
        if self.sampled != "all" or self.held:
            raise wrong(
                "sampled",
                "expected all, and no node held: with elastic_prior: loads every node is sampled; preset: paper has "
                "elastic_prior: boltzmann, with which some may be",
            )
        if not self.normalised:
            raise wrong("normalised", "expected true with elastic_prior: loads, which is a proper density of u")
        if self.t_elastic != ModelConfig.model_fields["t_elastic"].default:
            raise wrong(
                "t_elastic",
                "belongs to elastic_prior: boltzmann (preset: paper); random loads have body_load and surface_load",
            )
        for name in ("body_load", "surface_load"):
            if getattr(self, name) is None:
                raise wrong(name, "missing: random loads need its size, or {median: 0.1, log_sd: 3} to infer it")
        inferred = any(isinstance(load, ScalePrior) for load in (self.body_load, self.surface_load))
        if inferred and self.fixed is not None and not any(self.fixed.values()):
            raise wrong(
                "fixed",
                "the loads have a prior and no λ or μ is known: their common scale cannot be told; fix one parameter, "
                "or both loads",
            )

    @property
    def is_elastography(self) -> bool:
        """Whether no node is sampled."""
        return not isinstance(self.sampled, str) and not set(self.sampled) - set(self.held)

    def _require_rest(self) -> None:
        for node, displacement in self.held.items():
            if any(displacement):
                raise wrong(
                    f"held.{node}",
                    "with normalised: true a node is held where it is, (0, 0, 0), only: the energy of a prescribed "
                    "displacement is part of the normaliser, which leaves it out",
                )
        if self.held and self.rigid_sd is not None:
            raise wrong(
                "rigid_sd",
                "with normalised: true expected null where nodes are held: these couple the rigid motions of the "
                "sampled nodes with their strain, and the normaliser knows the elastic prior alone",
            )

    def require_proper_priors(self, tissues: Sequence[str]) -> None:
        """Refuse flat priors on [low, ∞) of free parameters where the density is normalised, or u_B given.

        With them the images tell ratios alone, and have a limit where one goes to infinity.

        Raises
        ------
        ValueError
        """
        known = self.known(tissues)
        case = "a given boundary" if self.is_elastography else "normalised: true"
        needed = self.normalised or self.is_elastography
        for name, tissue in product(get_args(Lame), tissues if needed else ()):
            prior = of_tissue(self, self.priors.get(name), tissue) or PriorConfig()
            if math.isinf(prior.high) and of_tissue(self, known.get(name), tissue) is None:
                raise wrong(
                    f"priors.{name}",
                    f"{case} needs a prior with a finite high (r2) for every free parameter, and {name} of "
                    f"{tissue} has none: the posterior would be improper",
                )

    def known(self, tissues: Sequence[str]) -> Mapping[Lame, Any]:
        """`fixed`, or its default for these tissues."""
        if self.fixed is not None:
            return self.fixed
        return {"mu": 1.0 if self.elasticity == "uniform" else {tissue_of_unit_mu(tissues): 1.0}}

    @property
    def _named_tissues(self) -> list[str]:
        sections = (*(self.fixed or {}).values(), *self.priors.values())
        return sorted({tissue for section in sections if isinstance(section, Mapping) for tissue in section})


def require_default_image_options(model: ModelConfig) -> None:
    """Raise InputError where a model without images has an option that says how they are compared."""
    for key in OF_IMAGES:
        if getattr(model, key) != ModelConfig.model_fields[key].default:
            raise InputError(f"model.{key} says how images are compared, and none are observed; leave it out")


def is_taken(name: str) -> bool:
    """Whether no observation may have this name, nor bring an unknown of this name."""
    return name in TAKEN or name.startswith("prior_")


def of_tissue(model: ModelConfig, given: Any, tissue: str) -> Any:
    """The option of one tissue, given for all or in a mapping by tissue; None where it is not given."""
    if not isinstance(given, Mapping):
        return given
    return next(iter(given.values()), None) if model.elasticity == "uniform" else given.get(tissue)


def wrong(key: str, message: str) -> PydanticCustomError:
    """An error that belongs to one key, given by its dotted path, of the section whose validator raises it."""
    return PydanticCustomError("wrong", "{message}", {"message": message, "key": key})
