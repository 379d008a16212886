"""What a registration model is made of, as a validated, immutable record."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool, field_validator, model_validator

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


class ModelConfig(BaseModel):
    """The posterior to sample; the defaults are the paper's.

    Attributes
    ----------
    elasticity : {"tissue", "uniform", "element"}
        One pair (λ, μ) for each tissue, one for all, or one for each tetrahedron.
    fixed : mapping, optional
        Parameters that are known: ``{"mu": {"gm": 1.0}}`` by tissue name (by element it fixes every
        element of that tissue), or ``{"mu": 1.0}`` for all entries of μ. The default fixes μ of "gm" (or
        of the first tissue) at 1, uniform: μ at 1; the scale of λ, μ is not identified otherwise.
    priors : mapping
        A prior for each of "lam", "mu", or one for each tissue: ``{"lam": {"gm": PriorConfig(high=60)}}``;
        what is not named has the flat prior on [0, ∞).
    similarity : {"ssd"}
        Sum of squared differences, eq. (1).
    t_similarity, t_elastic : float
        Boltzmann temperatures T_s (mm³ times squared intensity) and T_r (energy).
    normalised : bool
        False: the paper's density, without the normaliser of the elastic prior in λ, μ. True is refused.
    interpolation : {"linear", "cubic"}
        Of the moving image; cubic where gradients are used.
    quadrature : {"gauss4", "gauss32", "gauss256", "voxels"}
        Points of the integral in eq. (1): 4, 32 or 256 for each tetrahedron, or the fixed image's voxel
        centres inside the mesh.
    sampled : "boundary", "all" or list of int
        Nodes whose displacements are sampled; the others follow by the elastic solve.
    held : mapping of int to (x, y, z)
        Nodes with a known displacement, mm; they are not sampled.
    rigid_sd : float, optional
        Standard deviation, mm, of the root-mean-square displacement of each of the six rigid motions of
        the sampled nodes under a Gaussian prior; None is flat.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    elasticity: Literal["tissue", "uniform", "element"] = "tissue"
    fixed: dict[Lame, Positive | dict[str, Positive]] | None = None
    priors: dict[Lame, PriorConfig | dict[str, PriorConfig]] = {}
    similarity: Literal["ssd"] = "ssd"
    t_similarity: Positive = 0.05
    t_elastic: Positive = 1e4
    normalised: StrictBool = False
    interpolation: Literal["linear", "cubic"] = "linear"
    quadrature: Literal["gauss4", "gauss32", "gauss256", "voxels"] = "gauss4"
    sampled: Literal["boundary", "all"] | list[Annotated[int, Field(ge=0)]] = "boundary"
    held: dict[Annotated[int, Field(ge=0)], Vector] = {}
    rigid_sd: Positive | None = None

    @field_validator("normalised")
    @classmethod
    def _only_the_paper(cls, value: bool) -> bool:
        if value:
            raise ValueError(
                "the density with the elastic prior's normaliser is not part of this version; use normalised: false"
            )
        return value
