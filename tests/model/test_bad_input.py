"""What a user can get wrong when building a posterior: one clear ValueError each."""

from __future__ import annotations

import re

import numpy as np
import pytest

import bayesreg as br
from tests.options import posterior_of
from tests.phantoms import LAM, MU, ball_mesh, box_mesh, flat_skull, smooth_image

MESH = ball_mesh(spacing=30.0)
FIXED, MOVING = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))


def build(f=FIXED, m=MOVING, mesh=MESH, skull=None, **options):
    return posterior_of(f, m, mesh, skull, **options)


def shifted(image, by):
    affine = image.affine.copy()
    affine[:3, 3] += by
    return br.Image(image.voxels, affine)


def test_the_phantom_itself_is_fine():
    assert build().sampled.tolist() == MESH.boundary.tolist()


@pytest.mark.parametrize("which", ["fixed", "moving"])
def test_images_and_mesh_must_overlap(which):
    images = {"fixed": FIXED, "moving": MOVING}
    images[which] = shifted(images[which], (500.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=f"{which} image and the mesh do not overlap: 0 of {len(MESH.points)} nodes"):
        build(*images.values())


@pytest.mark.parametrize(
    ("sampled", "held"),
    [([0, 5], {}), ([0], {5: (0.0, 0.0, 0.0)}), ([0, 0, 5, 5], {})],
    ids=["two", "one and a held one", "two, named twice"],
)
def test_two_nodes_do_not_hold_a_mesh(sampled, held):
    with pytest.raises(ValueError, match=r"2 sampled and held nodes do not hold .* at least three"):
        build(sampled=sampled, held=held)


def test_three_nodes_on_a_line_do_not_hold_a_mesh():
    box = box_mesh(2, jitter=0.0)
    images = [smooth_image(box.points, seed=seed) for seed in (1, 2)]
    on_edge = np.flatnonzero((box.points[:, 1:] == 0).all(axis=1)).tolist()
    assert len(on_edge) == 3
    with pytest.raises(ValueError, match="not on one line"):
        build(*images, box, sampled=on_edge)
    with pytest.raises(ValueError, match="not on one line"):
        build(*images, box, sampled=on_edge[:2], held={on_edge[2]: (0.0, 0.0, 1.0)})
    off_edge = int(np.flatnonzero(box.points[:, 2] == 20.0)[0])
    assert len(build(*images, box, sampled=on_edge[:2], held={off_edge: (0.0, 0.0, 1.0)}).sampled) == 2


def test_something_must_be_sampled():
    priors = {"lam": {"high": 9.0}, "mu": {"high": 9.0}}
    with pytest.raises(ValueError, match="no node is sampled"):
        build(sampled=[0, 5], held=dict.fromkeys((0, 5, 9), (0.0, 0.0, 0.0)), priors=priors)


@pytest.mark.parametrize(
    ("options", "name"), [({"sampled": [0, 1, 2, 31]}, "nodes"), ({"held": {31: (0.0, 0.0, 0.0)}}, "held")]
)
def test_nodes_must_exist(options, name):
    with pytest.raises(ValueError, match=rf"elastic_prior.{name} names node 31, but the mesh has 31 nodes"):
        build(**options)
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        build(sampled=[-1, 0, 1, 2])


@pytest.mark.parametrize("bounds", [(3.0, 3.0), (5.0, 2.0)])
def test_priors_need_an_interval(bounds):
    low, high = bounds
    with pytest.raises(ValueError, match=rf"r1 < r2.*low = {low}, high = {high}"):
        build(priors={"lam": {"low": low, "high": high}})


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"low": -1.0}, "greater than or equal to 0"),
        ({"alpha": 0.0, "high": 1.0}, "greater than 0"),
        ({"alpha": 2.0}, r"high = inf .* needs alpha = beta = 1"),
        ({"low": np.nan, "high": 1.0}, "finite"),
        ({"high": np.nan}, "r1 < r2"),
        ({"r1": 0.0}, "r1"),
    ],
)
def test_priors_need_sense(prior, message):
    with pytest.raises(ValueError, match=message):
        build(priors={"mu": prior})


@pytest.mark.parametrize("options", [{"fixed": {"mu": {"bone": 1.0}}}, {"priors": {"mu": {"bone": {"high": 2.0}}}}])
@pytest.mark.parametrize("elasticity", ["tissue", "uniform", "element"])
def test_tissues_must_exist(options, elasticity):
    with pytest.raises(ValueError, match=r"names \['bone'\].*tissues are \['csf', 'gm', 'wm'\]"):
        build(elasticity=elasticity, **options)


def test_one_entry_cannot_be_fixed_at_two_values():
    with pytest.raises(ValueError, match="different values, but elasticity is uniform"):
        build(elasticity="uniform", fixed={"mu": {"gm": 1.0, "wm": 2.0}})


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"fixed": {"mu": {"gm": -1.0}}}, "fixed"),
        ({"fixed": {"nu": 0.3}}, "fixed"),
        ({"t_similarity": 0.0}, "similarity.ssd.temperature"),
        ({"t_elastic": -5.0}, "elastic_prior.boltzmann.temperature"),
        ({"rigid_sd": 0.0}, "rigid_sd"),
        ({"elasticity": "voxel"}, "elasticity"),
        ({"interpolation": "nearest"}, "interpolation"),
        ({"quadrature": "gauss5"}, "quadrature"),
        ({"sampled": "interior"}, "elastic_prior.boltzmann.nodes"),
        ({"held": {0: (1.0, 2.0)}}, "elastic_prior.boltzmann.held"),
        ({"held": {0: (np.nan, 0.0, 0.0)}}, "held"),
        ({"t_similarty": 0.05}, "t_similarty"),
    ],
)
def test_options_are_validated(options, where):
    with pytest.raises(ValueError, match=where):
        build(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"finite high \(r2\).* lam of the tissue has none"),
        ({"priors": {"lam": {"high": 9.0}}}, "mu of csf has none"),
        ({"priors": {"lam": {"high": 9.0}, "mu": {"gm": {"high": 9.0}}}, "fixed": {}}, "mu of csf has none"),
        ({"elasticity": "uniform"}, "lam of the tissue has none"),
        ({"priors": {"lam": {"high": 9.0}}, "fixed": {"mu": 1.0}, "held": {3: (0.0, 0.0, 1.0)}}, "held where it is"),
    ],
)
def test_the_proper_density_needs_proper_priors_and_nodes_at_rest(options, message):
    with pytest.raises(ValueError, match=message):
        build(normalised=True, **options)
    build(normalised=False, **options)


def test_a_skull_that_forbids_everything():
    skull = flat_skull(MESH.points, axis=0, wall=-1000.0, voxel=4.0)
    assert skull.voxels.all()
    with pytest.raises(ValueError, match="forbids every voxel"):
        build(skull=skull)


def test_a_skull_that_cuts_the_mesh():
    """Some sampled nodes start where they may never be: no chain could start from rest."""
    wall = float(np.median(MESH.points[:, 0]))
    skull = flat_skull(MESH.points, axis=0, wall=wall, voxel=4.0)
    inside = int((MESH.points[MESH.boundary, 0] > wall).sum())
    with pytest.raises(ValueError, match=rf"{inside} of (the )?{len(MESH.boundary)} .*skull"):
        build(skull=skull)


@pytest.mark.parametrize(
    ("name", "shape"), [("u_boundary", (3, 3)), ("u_boundary", (len(MESH.boundary),)), ("lam", (2,)), ("mu", ())]
)
@pytest.mark.parametrize("method", ["logdensity_constrained", "energies", "unconstrain"])
def test_shapes_of_values(name, shape, method):
    values = {"u_boundary": np.zeros((len(MESH.boundary), 3)), "lam": LAM, "mu": MU}
    values[name] = np.ones(shape)
    with pytest.raises(ValueError, match=rf"'{name}'.*must have shape .* got {re.escape(str(shape))}"):
        getattr(build(), method)(values)


def test_values_must_be_complete():
    with pytest.raises(ValueError, match="lack 'mu'"):
        build().logdensity_constrained({"u_boundary": np.zeros((len(MESH.boundary), 3)), "lam": LAM})


def test_voxel_quadrature_needs_voxels():
    """A grid so coarse that no voxel centre lies inside the mesh."""
    affine = np.diag([400.0, 400.0, 400.0, 1.0])
    affine[:3, 3] = MESH.points.mean(axis=0) - 200.0
    with pytest.raises(ValueError, match="no voxel centre"):
        build(br.Image(np.arange(8.0).reshape(2, 2, 2), affine), quadrature="voxels")
