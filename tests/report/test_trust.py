"""What a report says of how far its intervals can be trusted."""

from __future__ import annotations

import pytest

from bayesreg.report.trust import explain_intervals
from bayesreg.report.verdict import doubt_of_equilibrium, warnings_of
from tests.phantoms import box_mesh
from tests.report.test_verdict import elastic

MANIFEST = {
    "independent_points": {"images": 25_000.0},
    "observations": {
        "images": {
            "kind": "images",
            "values": 100_000,
            "options": {"similarity": {"kind": "student_t", "degrees_of_freedom": 4.0}},
        }
    },
    "model": {"elastic_prior": {"nodes": "all"}},
    "implied_noise_sd": 0.04,
    "residual_sd": 0.04,
    "displacement_sd": {"nodes": 0.08, "mesh": 0.05},
}


def test_what_widens_the_intervals_is_told_with_its_size():
    correlated, outliers, mesh = explain_intervals(MANIFEST)
    assert "leaves 25,000 of the 100,000 points" in correlated
    assert "intervals are 2.0 times as wide" in correlated
    assert "ν = 4.00" in outliers
    assert "0.050 mm" in mesh
    assert "0.080 mm" in mesh


def test_inverted_tetrahedra_of_the_draws_are_told():
    assert any("0.030 % of the tetrahedra" in text for text in explain_intervals({"inverted_share_of_draws": 3e-4}))
    assert explain_intervals({"inverted_share_of_draws": 0.0}) == []


def test_nothing_is_told_of_what_a_run_does_not_have():
    assert explain_intervals({}) == []
    observed = {"images": {"kind": "images", "values": 100_000, "options": {"similarity": {"kind": "ssd"}}}}
    independent = MANIFEST | {"independent_points": {"images": 100_000.0}, "observations": observed}
    assert len(explain_intervals(independent)) == 1


@pytest.mark.parametrize(
    ("sampled", "pair", "warned"),
    [("boundary", None, True), ("boundary", {"kind": "paper"}, False), ("all", None, False)],
)
def test_a_strict_equilibrium_of_real_images_is_warned_of(sampled, pair, warned):
    manifest = MANIFEST | {"model": {"elastic_prior": {"nodes": sampled}}, "pair": pair}
    warnings = warnings_of(manifest, box_mesh(), elastic([1.0] * 3, [1.0] * 3))
    assert any("preset: registration" in text for text in warnings) == warned
    assert (
        doubt_of_equilibrium({"elastic_prior": {"nodes": sampled}}, simulated=pair is not None) is not None
    ) == warned
