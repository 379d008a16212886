"""Points that look like a mistake: each is told in one sentence, and the rest is as without it."""

import logging

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import bayesreg as br
from bayesreg.model.state import state_of
from tests.phantoms import box_mesh

BOX = box_mesh(2, size=40.0)
# Two sides of the organ are alike to no other reading: x from 60 to 100 mm, y from 20 to 60, z from −30 to 10.
CORNER = np.array([60.0, 20.0, -30.0])
MESH = br.TetMesh.from_arrays(BOX.points + CORNER, BOX.cells, np.zeros(len(BOX.cells), int), ("organ",))
FAR = np.array([70.0, 0, 0])
MODEL = br.ModelConfig(preset="registration")
GRID = br.Image(np.zeros((40, 30, 50)), np.array([[2.0, 0, 0, 40], [0, 2.0, 0, 10], [0, 0, 1.0, -45], [0, 0, 0, 1]]))


def pairs(count=12, seed=0):
    fixed = CORNER + np.random.default_rng(seed).uniform(2, 38, (count, 3))
    return fixed, fixed + 0.05 * (fixed - CORNER - 20)


def placed(fixed, moving, **options):
    observation = br.Landmarks(fixed, moving, 1.0, **options)
    return br.build_posterior(MESH, [observation], MODEL)


def test_sound_points_are_no_matter(caplog):
    fixed, moving = pairs()
    remarks = placed(fixed, moving, grids={"the labels": GRID}).observations["landmarks"].remarks
    assert remarks == ()
    assert not caplog.messages


def test_an_exact_copy_of_a_pair_counts_once(caplog):
    fixed, moving = pairs()
    own = placed(np.r_[fixed, fixed[[3, 3]]], np.r_[moving, moving[[3, 3]]])
    assert caplog.messages == ["landmarks: these pairs repeat another one exactly, and do not count: 13, 14."]
    plain = placed(fixed, moving)
    values = plain.reference()
    assert float(own.logdensity_constrained(values)) == float(plain.logdensity_constrained(values))
    assert own.observations["landmarks"].labels == plain.observations["landmarks"].labels


def test_one_place_with_two_partners_is_told_and_the_neighbours_decide(caplog):
    fixed, moving = pairs(30)
    moving += np.random.default_rng(6).normal(0, 0.1, fixed.shape)
    points = np.r_[fixed, fixed[[4]]], np.r_[moving, moving[[4]] + (12.0, 0.0, 0.0)]
    own = br.build_posterior(MESH, [br.Landmarks(*points, br.ScalePrior(median=1.0, log_sd=2.0))], MODEL)
    draws = br.sample(own, chains=2, draws=60, seed=1, progress=False).idata.posterior
    mean = {name: draws[name].mean(("chain", "draw")).values for name in own.reference()}
    state, observation = state_of(own.data.body, own.data.blocks, own.fill(mean)), own.observations["landmarks"]
    by_draw = {name: draws[name].values.reshape(-1, *draws[name].shape[2:]) for name in own.reference()}
    contradiction, wrong = observation.doubts(observation.summarise(own, state, by_draw))
    assert caplog.messages[0] == contradiction
    assert "share one place in the fixed image" in contradiction
    assert "5 and 31 (12 mm)" in contradiction
    assert "1 pair of points is probably wrong" in wrong
    assert ": 31 (" in wrong
    predicted = own.data.terms["landmarks"].predicted(state)[:30]
    assert np.abs(predicted - 0.05 * (fixed - CORNER - 20)).max() < 0.4


@pytest.mark.parametrize("thickness", [0.0, 0.5, 8.0])
def test_points_in_one_plane_are_told(caplog, thickness):
    fixed, _ = pairs(20)
    flat = (fixed - fixed.mean(axis=0)) * (0.5, 0.5, thickness / 40)
    flat = Rotation.from_rotvec([0.4, -0.3, 0.2]).apply(flat) + fixed.mean(axis=0)
    placed(flat, flat)
    assert ["nearly in one plane" in message for message in caplog.messages] == [True] * (thickness < 1)


@pytest.mark.parametrize(
    ("given", "claim"),
    [
        (lambda fixed, moving: (GRID.world_to_voxel(fixed), moving), "voxel indices of the labels; then convert them"),
        (lambda fixed, moving: (fixed * (-1, -1, 1), moving), "by which LPS and RAS differ; then state the right one"),
        (lambda fixed, moving: (moving + FAR, fixed), "swapped with their partners; then swap the fixed"),
    ],
    ids=["voxels", "LPS", "swapped"],
)
def test_another_reading_that_fits_is_suspected(given, claim):
    fixed, moving = pairs()
    with pytest.raises(br.InputError, match="fewer than 4 points are left; 12 of 12 would lie in the mesh .*" + claim):
        placed(*given(fixed, moving), grids={"the labels": GRID})


def test_where_it_is_only_a_suspicion_the_run_goes_on(caplog):
    """Every reading of half of the points is possible."""
    fixed, moving = pairs()
    shift = np.where(np.arange(12) % 2, 70.0, 0.0)[:, None] * (1, 0, 0)
    own = placed(moving + shift, fixed)
    (sentence,) = caplog.messages
    assert "they are left out; 12 of 12 would lie in the mesh or near it if they were swapped" in sentence
    assert len(own.observations["landmarks"].labels) == 6


def test_a_point_of_its_own_that_lies_out_is_no_ground_for_a_suspicion(caplog):
    caplog.set_level(logging.WARNING)
    fixed, moving = pairs()
    fixed[2, 0] += 70.0
    placed(fixed, moving, grids={"the labels": GRID})
    (sentence,) = caplog.messages
    assert sentence.endswith("edges (22.4 mm): 3; they are left out.")


@pytest.mark.parametrize(
    ("reading", "claim"),
    [
        (GRID.world_to_voxel, "voxel indices of the labels; then convert them"),
        (lambda moving: moving * (-1, -1, 1), "by which LPS and RAS differ; then state the right one"),
        (lambda moving: moving / 1000, "in metres; then convert them to mm"),
    ],
    ids=["voxels", "LPS", "metres"],
)
def test_another_reading_of_the_moving_points_is_refused(reading, claim):
    fixed, moving = pairs()
    with pytest.raises(
        br.InputError, match=r"half of the moving points lie more than .* from their partners.*" + claim
    ):
        placed(fixed, reading(moving), grids={"the labels": GRID})


def test_most_points_out_of_the_organ_are_refused_where_another_reading_fits():
    fixed, moving = pairs()
    shift = np.where(np.arange(12) % 3, 70.0, 0.0)[:, None] * (1, 0, 0)
    with pytest.raises(br.InputError, match=r"8 of 12 points lie .* 12 of 12 would lie .* if they were swapped"):
        placed(moving + shift, fixed)


def test_moving_points_of_other_coordinates_are_told(caplog):
    fixed, moving = pairs()
    placed(fixed, moving + np.array([0, 0, 300.0]))
    (sentence,) = caplog.messages
    assert "lie more than 300 mm away from their partners" in sentence
    assert "data.pose: unknown" in sentence


def test_pairs_in_another_order_are_told(caplog):
    fixed, moving = pairs(30)
    placed(fixed, np.roll(moving, 7, axis=0))
    (sentence,) = caplog.messages
    assert "Are the fixed and the moving points in the same order?" in sentence


@pytest.mark.parametrize("kind", ["landmarks", "surface"])
def test_points_in_metres_about_the_origin_are_refused(kind):
    """They all lie within the organ, if the organ lies about the origin."""
    mesh = br.TetMesh.from_arrays(BOX.points - 20, BOX.cells, np.zeros(len(BOX.cells), int), ("organ",))
    points = np.random.default_rng(0).uniform(-18, 18, (12, 3)) / 1000
    own = br.Landmarks(points, points, 1.0) if kind == "landmarks" else br.Surface(points)
    with pytest.raises(br.InputError, match=r"all 12 points lie within .* are they in metres"):
        br.build_posterior(mesh, [own], MODEL)


@pytest.mark.parametrize(
    ("reading", "claim"),
    [(GRID.world_to_voxel, "voxel indices of the labels"), (lambda points: points / 1000, "are they in metres")],
    ids=["voxels", "metres"],
)
def test_another_reading_of_a_surface_is_refused(reading, claim):
    labels = GRID.with_voxels(np.ones(GRID.voxels.shape, int))
    points = CORNER + np.random.default_rng(0).uniform(0, 40, (30, 3)) * (1, 1, 0)
    with pytest.raises(br.InputError, match=claim):
        br.build_posterior(MESH, [br.Surface(reading(points), tissue=labels)], MODEL)
