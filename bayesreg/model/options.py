"""The options of a registration model, as a validated, immutable record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from bayesreg.model.elastic.boltzmann import Boltzmann
from bayesreg.model.elastic.loads import RandomLoads
from bayesreg.model.field import FieldConfig
from bayesreg.settings import NotNegative, Positive, ScalePrior, Section, by_kind, is_inferred, wrong
from bayesreg.tissues import MU_LOG_SD, RATIO_LOG_SD, is_fluid, tissue_of_unit_mu, usual_stiffness

# Names of blocks and other sites of the program. No observation may use them.
TAKEN = (
    "u_boundary", "lam", "mu", "t_elastic", "body_load", "surface_load", "field", "field_sd", "elastic", "rigid",
    "skull", "barrier", "support", "solved", "u", "strain_energy", "similarity_energy", "solver_iterations",
    "solver_failed", "outside_support", "evaluation",
)  # fmt: skip

Lame = Literal["lam", "mu"]


class PriorConfig(Section):
    """Beta prior scaled to [low, high]; with high = ∞ the flat improper prior on [low, ∞).

    Attributes
    ----------
    alpha, beta : float
        Shape parameters A and B, positive; 1 and 1 is flat.
    low, high : float
        r1 and r2, in the unit of the parameter (relative, or kPa), 0 ≤ low < high.
    """

    alpha: Positive = 1.0
    beta: Positive = 1.0
    low: NotNegative = 0.0
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


# The prior of λ or μ: log-normal, or a scaled Beta.
LamePrior = PriorConfig | ScalePrior


def _require_one_kind(prior: Any) -> Any:
    if isinstance(prior, Mapping) and {"median", "log_sd"} & set(prior) and set(PriorConfig.model_fields) & set(prior):
        raise ValueError(
            "a prior is log-normal (median, log_sd) or a Beta prior of a range (alpha, beta, low, high), not both"
        )
    return prior


def _kind_of_prior(prior: Any) -> str:
    """Tell which kind of prior is meant, so that errors are those of this kind alone."""
    if isinstance(prior, ScalePrior) or (isinstance(prior, Mapping) and {"median", "log_sd"} & set(prior)):
        return "log_normal"
    is_range = isinstance(prior, Mapping) and set(PriorConfig.model_fields) & set(prior)
    is_tissues = isinstance(prior, Mapping) and not is_range
    return "by_tissue" if is_tissues else "scaled_beta"


_OneKind = BeforeValidator(_require_one_kind)
_ScaledBeta = Annotated[PriorConfig, Tag("scaled_beta")]
_LogNormal = Annotated[ScalePrior, Tag("log_normal")]
_PriorOfTissue = Annotated[_ScaledBeta | _LogNormal, Discriminator(_kind_of_prior), _OneKind]
_ByTissue = Annotated[dict[str, _PriorOfTissue], Tag("by_tissue")]
_PriorOfAll = Annotated[_ScaledBeta | _LogNormal | _ByTissue, Discriminator(_kind_of_prior), _OneKind]

# The options of each preset by its name. Options that the user gives replace them.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "registration": {"elastic_prior": {"kind": "loads"}, "least_volume": 0.1},
}


def _require_tagged(value: object) -> object:
    """Return the prior with its kind; without a given kind, it is the paper's."""
    value = by_kind(value)
    return {"kind": "boltzmann", **value} if isinstance(value, Mapping) else value


class ModelConfig(Section):
    """The options of the posterior, except those of an observation; the defaults are the paper's.

    Attributes
    ----------
    preset : {"paper", "registration"}
        Defaults of options, here and in observations: those of the paper, or those that suit real data.
    elasticity : {"tissue", "uniform", "element", "field"}
        One pair (λ, μ) for each tissue, one for all, one for each tetrahedron; or one for each tissue, times the
        exponential of a smooth random field over its tetrahedra.
    field : FieldConfig, optional
        Prior of that field; only for "field".
    fixed : mapping, optional
        Parameters that are known: ``{"mu": {"liver": 1.0}}`` by tissue name (by element it fixes every
        element of that tissue), or ``{"mu": 1.0}`` for all entries of μ. The default fixes μ of one tissue
        (`bayesreg.tissues.tissue_of_unit_mu`) at 1, uniform: μ at 1; the scale of λ, μ is not identified otherwise.
    priors : mapping
        A prior for each of "lam", "mu", or one for each tissue, log-normal or a scaled Beta:
        ``{"mu": {"tumour": ScalePrior(median=3, log_sd=0.5)}, "lam": PriorConfig(high=60)}``. What is not named has,
        with preset "paper", the flat prior on [0, ∞); with "registration" a log-normal one about the usual stiffness
        of its tissue (`with_default_priors`).
    elastic_prior : Boltzmann or RandomLoads
        The prior of the displacements: exp(−E_r / T_r), eq. (12), of the nodes that it names; or equilibrium with
        random loads, K u = q in place of eq. (7), of all nodes, which depends much less on the mesh.
    skull_width : float
        Depth inside the skull, in voxels of its mask, that counts as one standard deviation: masks are no better known
        than half a voxel. 0: no sampled node lies in the skull, as in the paper; only for the sampler rwmh, since a
        gradient does not show a hard constraint.
    least_volume : float
        0: tetrahedra may be inverted. Otherwise a barrier acts on every tetrahedron that keeps less than this
        share of its volume (`bayesreg.model.elastic.barrier`). Like the skull, it is not part of the normaliser.
    rigid_sd : float, optional
        Standard deviation, mm, of the root-mean-square displacement of each of the six rigid motions of
        the sampled nodes under a Gaussian prior; None is flat.
    """

    preset: Literal["paper", "registration"] = "paper"
    elasticity: Literal["tissue", "uniform", "element", "field"] = "tissue"
    field: FieldConfig | None = None
    fixed: dict[Lame, Positive | dict[str, Positive]] | None = None
    priors: dict[Lame, _PriorOfAll] = Field(default={})
    elastic_prior: Annotated[Boltzmann | RandomLoads, Field(discriminator="kind"), BeforeValidator(_require_tagged)] = (
        Boltzmann()
    )
    skull_width: NotNegative = 0.5
    least_volume: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    rigid_sd: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _take_over_preset(cls, options: Any) -> Any:
        if not isinstance(options, Mapping):
            return options
        preset = dict(PRESETS.get(str(options.get("preset")), {}))
        prior = by_kind(options.get("elastic_prior"))
        if isinstance(prior, Mapping) and "kind" not in prior and "elastic_prior" in preset:
            options = {**options, "elastic_prior": {**preset["elastic_prior"], **prior}}
        return {**preset, **options}

    @model_validator(mode="after")
    def _is_proper(self) -> ModelConfig:
        if self.field is not None and self.elasticity != "field":
            raise wrong("field", f"expected null: it belongs to elasticity: field, which is {self.elasticity} here")
        elastic = self.elastic_prior
        inferred = [name for name, scale in elastic.scales.items() if is_inferred(scale)]
        if inferred and self.fixed is not None and not any(self.fixed.values()):
            raise wrong(
                "fixed",
                f"{' and '.join(inferred)} of the elastic prior {'has' if len(inferred) == 1 else 'have'} a prior and "
                "no λ or μ is known: their common scale cannot be told apart; fix one parameter, or all scales of the "
                "elastic prior",
            )
        if elastic.normalised and elastic.held and self.rigid_sd is not None:
            raise wrong(
                "rigid_sd",
                "with normalised: true expected null where nodes are held: these couple the rigid motions of the "
                "sampled nodes with their strain, and the normaliser knows the elastic prior alone",
            )
        if elastic.normalised or elastic.samples_no_node:
            # If the options name no tissue, the mesh still has at least one. It is free or known by the rule of
            # `known`.
            self.require_proper_priors(self._named_tissues or ("the tissue",))
        return self

    def require_proper_priors(self, tissues: Sequence[str]) -> None:
        """Refuse flat priors on [low, ∞) of free parameters if the density is normalised or u_B is given.

        With flat priors, the images determine only ratios, and the density does not decrease to zero if a parameter
        goes to infinity.

        Raises
        ------
        ValueError
        """
        fixed = self.known(tissues)
        elastic = self.elastic_prior
        case = "a given boundary" if elastic.samples_no_node else f"elastic_prior: {elastic.kind}, normalised,"
        needed = elastic.normalised or elastic.samples_no_node
        priors = self.with_default_priors(tissues).priors
        for name, tissue in product(get_args(Lame), tissues if needed else ()):
            prior = of_tissue(self, priors.get(name), tissue) or PriorConfig()
            is_flat = isinstance(prior, PriorConfig) and math.isinf(prior.high)
            if is_flat and of_tissue(self, fixed.get(name), tissue) is None:
                raise wrong(
                    f"priors.{name}",
                    f"{case} needs a prior with a finite high (r2), or a log-normal one, for every free parameter, and "
                    f"{name} of {tissue} has none: the posterior would be improper",
                )

    def with_default_priors(self, tissues: Sequence[str]) -> ModelConfig:
        """Return the model with a prior for λ and μ of all of these tissues; a given prior stays.

        With preset "registration", μ of a tissue is log-normal about its usual value, relative to a tissue whose μ is
        known, and λ about its usual multiple of μ (`bayesreg.tissues.STIFFNESS`). With "paper" nothing is added: what
        has no prior is flat.
        """
        if self.preset == "paper":
            return self
        priors: dict[Lame, Any] = {**self.priors}
        for name in get_args(Lame):
            given = priors.get(name) or {}
            if self.elasticity == "uniform":
                priors[name] = given or self._default_prior(name, tissue_of_unit_mu(tissues), tissues)
            elif isinstance(given, Mapping):
                defaults = {tissue: self._default_prior(name, tissue, tissues) for tissue in tissues}
                priors[name] = {**defaults, **given}
        return self.model_copy(update={"priors": priors})

    def _default_prior(self, name: Lame, tissue: str, tissues: Sequence[str]) -> ScalePrior:
        usual, known = usual_stiffness(tissue), self.known(tissues).get("mu")
        # Usual values are relative: one known μ tells the unit of all, preferably that of a solid.
        known_by_tissue = {other: of_tissue(self, known, other) for other in sorted(tissues, key=is_fluid)}
        unit = next((mu / usual_stiffness(other).mu for other, mu in known_by_tissue.items() if mu is not None), 1.0)
        given = of_tissue(self, self.priors.get("mu"), tissue)
        of_mu = given if isinstance(given, ScalePrior) else ScalePrior(median=unit * usual.mu, log_sd=MU_LOG_SD)
        if name == "mu":
            return of_mu
        mu = known_by_tissue[tissue]
        median, log_sd = (of_mu.median, of_mu.log_sd) if mu is None else (mu, 0.0)
        # λ and μ are independent, and λ/μ varies as much where μ is known as where it is not.
        log_sd = math.sqrt(RATIO_LOG_SD**2 - min(log_sd, MU_LOG_SD) ** 2)
        return ScalePrior(median=usual.ratio * median, log_sd=log_sd)

    def known(self, tissues: Sequence[str]) -> Mapping[Lame, Any]:
        """Return `fixed`, or its default for these tissues."""
        if self.fixed is not None:
            return self.fixed
        return {"mu": 1.0 if self.elasticity == "uniform" else {tissue_of_unit_mu(tissues): 1.0}}

    @property
    def _named_tissues(self) -> list[str]:
        sections = (*(self.fixed or {}).values(), *self.priors.values())
        return sorted({tissue for section in sections if isinstance(section, Mapping) for tissue in section})


def is_reserved_name(name: str) -> bool:
    """Check whether a name is reserved: no observation, and no unknown that it brings, may use it."""
    return name in TAKEN or name.startswith("prior_")


def of_tissue(model: ModelConfig, option: Any, tissue: str) -> Any:
    """Return the option of one tissue, from one value for all or a mapping by tissue; None if it is not given."""
    if not isinstance(option, Mapping):
        return option
    return next(iter(option.values()), None) if model.elasticity == "uniform" else option.get(tissue)
