"""The model as a simulator: parameters and displacements from the prior, the fixed image at the quadrature points.

(λ, μ, T_s, T_r) come from their priors. u_B comes from a Gaussian whose precision is S / T_r, with the Schur complement
S of K, plus the precision of `rigid_sd` in the six rigid motions, which S leaves free. f_q is m(x_q + u(x_q)) plus
noise of the squared scale T_s / (2 w_q). With random loads, whose sizes come from their priors, the displacements of
all nodes have the precision K D⁻¹ K in place of S / T_r, and the noise is Student's t. A shading with Normal
coefficients is subtracted from m, and where m is ignored, f_q is any intensity that f has. The skull belongs to the
likelihood: a draw (λ, μ, u) with nodes in the skull is rejected. The prior is drawn by the oracle's matrices and NumPy,
and shares no code with the density under test.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular

import bayesreg as br
from bayesreg.inference.target import without_normaliser
from bayesreg.mesh import TetMesh
from bayesreg.model import target
from bayesreg.model.observations.images.intensity_map import SHARE
from tests.options import image_options_of, model_of
from tests.oracles import paper
from tests.phantoms import box_mesh, flat_skull, smooth_image

MESH = box_mesh(2)
LAME = ("lam", "mu")
# Displacements are about half a millimetre in a box of 20 mm. The noise has sd 0.014, the image contrast one, and its
# waves are too long for several modes. Two of three draws touch the wall.
RIGID_SD, T_SIMILARITY, T_ELASTIC = 0.3, 0.008, 3.0
# Loads that cause displacements of the same size inside and at the surface.
BODY_LOAD, SURFACE_LOAD = 0.25, 0.6
DEGREES_OF_FREEDOM = 4.0
LOG_SD = 0.5
PRIOR = {"alpha": 3.0, "beta": 3.0, "high": 4.0}
WALL, WIDTH = 20.8, 0.1
# mm: of the box of 20 mm, the moving image is ignored below it.
IGNORED = 5.0


class Variant(NamedTuple):
    """A model to be calibrated.

    Attributes
    ----------
    skull : bool
        Whether a flat skull stands one millimetre beyond a face of the box.
    temperatures : bool
        Whether T_s and T_r are inferred; μ of one tissue is then known.
    loads : bool
        Random loads on all nodes in place of exp(−E_r / T_r), and Student's t noise; their sizes and T_s are inferred,
        and μ of one tissue is known.
    shaded : bool
        Whether a shading of degree one is inferred, and a part of the moving image is ignored.
    surrogate : bool
        Whether the few nodes are treated like many: trajectories then see the surrogate of the density.
    """

    skull: bool = False
    temperatures: bool = False
    loads: bool = False
    shaded: bool = False
    surrogate: bool = False

    @property
    def inferred(self) -> dict[str, float]:
        """The medians of the scales that have a log-normal prior."""
        if self.loads:
            return {"t_similarity": T_SIMILARITY, "body_load": BODY_LOAD, "surface_load": SURFACE_LOAD}
        return {"t_similarity": T_SIMILARITY, "t_elastic": T_ELASTIC} if self.temperatures else {}

    @property
    def options(self) -> dict[str, Any]:
        """The options of the model and of the pair of images (`tests.options`)."""
        elastic: dict[str, Any] = {"t_elastic": T_ELASTIC, "normalised": True}
        if self.loads:
            elastic = {"similarity": "student_t", "degrees_of_freedom": DEGREES_OF_FREEDOM}
        if self.shaded:
            elastic["intensity_map"] = 1
        return {
            "fixed": {"mu": {"gm": 2.0}} if self.inferred else {},
            "priors": dict.fromkeys(LAME, PRIOR),
            "t_similarity": T_SIMILARITY,
            "interpolation": "cubic",
            "rigid_sd": RIGID_SD,
            # In voxels of one millimetre.
            "skull_width": WIDTH,
            **elastic,
            **{name: {"median": median, "log_sd": LOG_SD} for name, median in self.inferred.items()},
        }


VARIANTS = {
    "no skull": Variant(),
    "skull": Variant(skull=True),
    "temperatures": Variant(temperatures=True),
    "loads": Variant(loads=True),
    "loads, shading and mask": Variant(loads=True, shaded=True),
    "loads with surrogate": Variant(loads=True, surrogate=True),
}


def treated_as_it_says(variant: Variant) -> AbstractContextManager[Any]:
    """Make the context in which posteriors of a variant have a surrogate if the variant says so."""
    return mock.patch.object(target, "CHEAP_NODES", 0) if variant.surrogate else nullcontext()


def require_treatment(variant: Variant, posterior: br.Posterior) -> None:
    """Raise an error if a posterior has a surrogate and its variant says no, or the reverse."""
    if (posterior.target.surrogate is not None) != variant.surrogate:
        raise ValueError("a variant with a surrogate must run in the context of `treated_as_it_says`")


def calibrated(variant: Variant, **planted: Any) -> br.Posterior:
    """The density under test; `planted` are options that are wrong on purpose."""
    moving = smooth_image(MESH.points, seed=1, blur=2.0)
    ignored = moving.with_voxels(moving.grid_points()[..., 0] < IGNORED) if variant.shaded else None
    skull = flat_skull(MESH.points, axis=0, wall=WALL, voxel=1.0) if variant.skull else None
    options = variant.options | planted
    # The fixed image is replaced at the quadrature points, one replication after another.
    pair = br.ImagePair(moving, moving, moving_ignore=ignored, **image_options_of(**options))
    return br.build_posterior(MESH, [pair], model_of(**options), skull)


class Simulator:
    """A simulator of parameters and displacements from the prior, and of data given these.

    Parameters
    ----------
    variant : Variant
    mesh : TetMesh
        The mesh whose nodes are displaced: the mesh of the posterior, or a finer one of the same box.
    """

    def __init__(self, variant: Variant, mesh: TetMesh = MESH) -> None:
        self.variant, self.mesh = variant, mesh
        self.posterior = calibrated(variant)

    @property
    def sampled(self) -> np.ndarray:
        """The nodes whose displacements are drawn."""
        return np.arange(len(self.mesh.points)) if self.variant.loads else self.mesh.boundary

    @cached_property
    def unit_stiffness(self) -> dict[str, np.ndarray]:
        """K of λ = 1, and of μ = 1, in one tissue: (3n, 3n) for each."""
        matrices = {}
        for name in LAME:
            of_tissue = []
            for tissue in range(len(self.mesh.names)):
                here = (self.mesh.tissue == tissue).astype(float)
                lam, mu = (here, 0 * here) if name == "lam" else (0 * here, here)
                of_tissue.append(paper.stiffness(self.mesh.points, self.mesh.cells, lam, mu).toarray())
            matrices[name] = np.stack(of_tissue)
        return matrices

    def stiffness(self, lam: np.ndarray, mu: np.ndarray) -> np.ndarray:
        """K of all nodes, (3n, 3n)."""
        return np.tensordot(lam, self.unit_stiffness["lam"], 1) + np.tensordot(mu, self.unit_stiffness["mu"], 1)

    def elastic_precision(self, values: dict[str, Any]) -> np.ndarray:
        """The precision of the displacements of the sampled nodes, without that of the rigid motions."""
        if not self.variant.loads:
            return self.schur_complement(values["lam"], values["mu"]) / values.get("t_elastic", T_ELASTIC)
        K, variances = self.stiffness(values["lam"], values["mu"]), np.zeros(len(self.mesh.points))
        for cell in self.mesh.cells:
            variances[cell] += values["body_load"] ** 2 * paper.volume(self.mesh.points[cell]) / 4
        for a, b, c in self.mesh.boundary_faces:
            first_edge, second_edge = (
                self.mesh.points[b] - self.mesh.points[a],
                self.mesh.points[c] - self.mesh.points[a],
            )
            variances[[a, b, c]] += values["surface_load"] ** 2 * np.linalg.norm(np.cross(first_edge, second_edge)) / 6
        return K @ (K / np.repeat(variances, 3)[:, None])

    def schur_complement(self, lam: np.ndarray, mu: np.ndarray) -> np.ndarray:
        """The Schur complement S of the boundary, (3b, 3b)."""
        K = self.stiffness(lam, mu)
        boundary = (3 * self.mesh.boundary[:, None] + np.arange(3)).ravel()
        interior = np.setdiff1d(np.arange(len(K)), boundary)
        coupling = K[np.ix_(interior, boundary)]
        return K[np.ix_(boundary, boundary)] - coupling.T @ np.linalg.solve(K[np.ix_(interior, interior)], coupling)

    def draw_displacement(self, rng: np.random.Generator, values: dict[str, Any]) -> Any:
        """Draw the displacements of the sampled nodes from the untruncated Gaussian prior, (b, 3) in mm."""
        nodes = self.sampled
        rigid = paper.rigid_modes(self.mesh.points[nodes]) / (RIGID_SD * np.sqrt(len(nodes)))
        precision = self.elastic_precision(values) + rigid @ rigid.T
        factor = np.linalg.cholesky(precision)
        return solve_triangular(factor, rng.normal(size=len(factor)), lower=True, trans=1).reshape(-1, 3)

    def draw_parameters(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw λ, μ (all entries) and the scales from their priors."""
        values: dict[str, Any] = {}
        for name in LAME:
            free = self.posterior.data.blocks[name].free.index
            values[name] = np.array(self.posterior.reference()[name])
            values[name][free] = PRIOR["high"] * rng.beta(PRIOR["alpha"], PRIOR["beta"], len(free))
        for name, median in self.variant.inferred.items():
            values[name] = median * np.exp(LOG_SD * rng.normal())
        if self.variant.shaded:
            values["images_shading"] = SHARE * rng.normal(size=len(self.posterior.reference()["images_shading"]))
        return values

    def draw_prior(self, rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        """Draw parameters and displacements; the skull rejects some. The first axis of each array is the draw."""
        draws: list[dict[str, Any]] = []
        while len(draws) < count:
            values = self.draw_parameters(rng)
            u = self.draw_displacement(rng, values)
            depth = np.maximum(self.mesh.points[self.sampled, 0] + u[:, 0] - WALL, 0.0)
            if not self.variant.skull or np.log(rng.uniform()) < -0.5 * ((depth / WIDTH) ** 2).sum():
                blocks = self.posterior.data.blocks
                values |= {name: values[name][blocks[name].free.index] for name in LAME}
                draws.append({"u_boundary": u, **values})
        return {name: np.stack([draw[name] for draw in draws]) for name in draws[0]}


def draw_data(posterior: br.Posterior, data: Any, key: Any, estimands: Any) -> Any:
    """Draw the fixed image at the quadrature points from the likelihood, given parameters and displacements."""
    u, images = (
        posterior.target.evaluate_estimands(without_normaliser(posterior.target, data), estimands).u,
        data.terms["images"],
    )
    t_similarity = estimands.get("t_similarity", data.blocks["t_similarity"].reference())
    key_noise, key_choice, key_any = jax.random.split(key, 3)
    heavy = isinstance(posterior.observations["images"].options.similarity, br.StudentT)

    def noise(key: Any, scale: Any) -> Any:
        return scale * (
            jax.random.t(key, DEGREES_OF_FREEDOM, scale.shape) if heavy else jax.random.normal(key, scale.shape)
        )

    scale = jnp.sqrt(t_similarity / (2 * images.quadrature.weights))
    seen = images.predicted(u, estimands) + noise(key_noise, scale)
    if images.visible is None:
        return seen
    f = images.fixed_values
    hidden = f.mean() + noise(key_any, jnp.sqrt(scale**2 + f.var()))
    return jnp.where(jax.random.uniform(key_choice, f.shape) < images.visible(images.places(u)), seen, hidden)


def observing(data: Any, fixed_values: Any) -> Any:
    """Replace the fixed image of the problem by values at the quadrature points."""
    return data.with_term("images", data.terms["images"]._replace(fixed_values=fixed_values))
