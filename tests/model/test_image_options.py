"""How images are compared: what is given, what the preset of the model completes, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import bayesreg as br
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(2)
FIXED, MOVING = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
WIDE = br.ScalePrior(median=0.05, log_sd=3.0)


def options_of(preset, **options):
    """The options of the pair in a posterior of a model with this preset."""
    post = br.build_posterior(MESH, [br.ImagePair(FIXED, MOVING, **options)], br.ModelConfig(preset=preset))
    return post.observations["images"].options


def test_the_papers_pair_is_compared_by_squared_differences():
    post = br.build_posterior(MESH, [br.ImagePair(FIXED, MOVING)])
    options = post.observations["images"].options
    assert options.similarity == br.SquaredDifferences(temperature=0.05)
    assert (options.quadrature, options.interpolation, options.intensity_map) == ("gauss4", "linear", None)
    assert len(post.images.positions) == 4 * len(MESH.cells)
    assert post.tempered
    assert "t_similarity" not in post.estimands(post.reference())


def test_registration_compares_voxels_by_students_t():
    post = br.build_posterior(MESH, [br.ImagePair(FIXED, MOVING)], br.ModelConfig(preset="registration"))
    options = post.observations["images"].options
    assert options.similarity == br.StudentT(temperature=WIDE)
    assert (options.quadrature, options.interpolation, options.intensity_map) == ("voxels", "cubic", 2)
    at_voxels = FIXED.world_to_voxel(np.asarray(post.images.positions))
    np.testing.assert_allclose(at_voxels, np.rint(at_voxels), atol=1e-9)
    assert not post.tempered
    assert {"t_similarity", "images_shading"} <= set(post.estimands(post.reference()))


@pytest.mark.parametrize("similarity", ["lncc", {"kind": "lncc"}, br.LocalCorrelation()])
def test_local_correlation_under_registration_has_no_map_and_infers_its_temperature(similarity):
    options = options_of("registration", similarity=similarity)
    assert options.similarity == br.LocalCorrelation(temperature=WIDE)
    assert (options.intensity_map, options.quadrature) == (None, "voxels")


def test_mutual_information_under_registration_has_a_known_temperature():
    options = options_of("registration", similarity="mi")
    assert options.similarity == br.MutualInformation(temperature=0.05)
    assert options.intensity_map is None


def test_what_is_given_replaces_the_preset_and_the_rest_stays():
    options = options_of("registration", similarity=br.StudentT(degrees_of_freedom=8.0), interpolation="linear")
    assert options.similarity == br.StudentT(degrees_of_freedom=8.0, temperature=WIDE)
    assert (options.interpolation, options.quadrature) == ("linear", "voxels")
    assert options_of("registration", similarity={"temperature": 0.3}).similarity == br.StudentT(temperature=0.3)
    assert options_of("registration", intensity_map=None).intensity_map is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"similarity": "lncc", "intensity_map": 1}, "images: intensity_map: .*maps of its own"),
        ({"similarity": "ncc"}, "images: similarity: .*'ncc'"),
        ({"similarity": {"kind": "ssd", "window_mm": 3.0}}, "images: similarity.ssd.window_mm"),
        ({"independent_points": "residual", "quadrature": "gauss4"}, "residual needs quadrature: voxels"),
        ({"blur": 1.0}, "images: blur"),
    ],
)
def test_what_is_wrong_is_told(options, message):
    with pytest.raises(br.InputError, match=message):
        br.ImagePair(FIXED, MOVING, **options)
