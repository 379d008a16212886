"""The density in symbols names every term that the run had, and none that it had not."""

import re

import bayesreg as br
from bayesreg.model.observations.images.options import ImageOptions
from bayesreg.report.observations import explanations, formula, observation_table

OPTIONS = ImageOptions(similarity="lncc").model_dump(mode="json")
IMAGES = {
    "kind": "images",
    "title": "pair of images",
    "options": OPTIONS,
    "log": -12.0,
    "values": 400,
    "residual_rms": 0.9,
}
POINTS = {"kind": "landmarks", "title": "pairs of points", "log": -3.0, "values": 24, "residual_rms": 1.1}
OWN = {"kind": "own", "title": "an observation of your own", "log": -0.5}


def plain(markup):
    return re.sub("<[^>]*>", "", str(markup))


def test_the_papers_density():
    manifest = {
        "observations": {"images": IMAGES},
        "model": {"elastic_prior": {"kind": "boltzmann", "normalised": False}, "rigid_sd": None},
    }
    assert plain(formula(manifest, elastography=False)) == "−Es / Ts − Er / Tr + log p(λ) + log p(μ)"
    assert plain(formula(manifest, elastography=True)) == "−Es / Ts + log p(λ) + log p(μ)"


def test_every_term_is_named():
    scales = {"t_similarity": {"median": 1.0, "log_sd": 1.0}, "points_sd": {"median": 1.0, "log_sd": 1.0}}
    model = {"elastic_prior": {"kind": "boltzmann", "normalised": True}, "rigid_sd": 3.0}
    observed = {"images": IMAGES, "t2": IMAGES, "points": POINTS, "<own>": OWN}
    density = formula({"observations": observed, "model": model, "scales": scales}, elastography=False)
    assert "&lt;own&gt;" in density
    assert plain(density) == (
        "−Es / Ts − Es(t2) / Ts(t2) + log p(points | u) + log p(&lt;own&gt; | u) − Er / Tr − log Z(λ, μ, Tr) "
        "+ log p(rigid motion of u) + log p(λ) + log p(μ) + log p(Ts) + log p(points sd)"
    )


def test_random_loads_take_the_place_of_the_elastic_energy():
    load = {"median": 0.1, "log_sd": 3.0}
    manifest = {
        "observations": {"images": IMAGES},
        "model": {"elastic_prior": {"kind": "loads", "body": load, "surface": load}},
        "scales": {"body_load": load, "surface_load": load},
    }
    density = plain(formula(manifest, elastography=False))
    sizes = "log p(sd of the random loads inside) + log p(sd of the random loads at the surface)"
    assert density == f"−Es / Ts + log p(u | λ, μ, random loads) + log p(λ) + log p(μ) + {sizes}"


def test_the_default_model_has_the_papers_density():
    """As a run writes its options down, those that it does not use among them."""
    model = br.ModelConfig().model_dump(mode="json")
    density = plain(formula({"observations": {"images": IMAGES}, "model": model}, elastography=False))
    assert density == "−Es / Ts − Er / Tr + log p(λ) + log p(μ)"


def test_landmarks_alone_have_no_similarity():
    manifest = {"observations": {"points": POINTS}, "model": {}}
    assert explanations(manifest) == []
    assert plain(formula(manifest, elastography=False)) == "log p(points | u) − Er / Tr + log p(λ) + log p(μ)"


def test_each_pair_of_images_says_what_it_compares():
    texts = [plain(text) for text in explanations({"observations": {"images": IMAGES, "t2": IMAGES, "points": POINTS}})]
    assert [text.split(" = ")[0] for text in texts] == ["Es", "Es(t2)"]
    assert all("affine map" in text for text in texts)


def test_what_is_no_density_of_images_is_called_a_pseudo_likelihood():
    paper, usual = ImageOptions().model_dump(mode="json"), ImageOptions(intensity_map=2).model_dump(mode="json")
    of_paper, of_usual, of_windows = (
        explanations({"observations": {"images": {**IMAGES, "options": options}}})[0]
        for options in (paper, usual, OPTIONS)
    )
    assert "pseudo-likelihood" not in of_paper
    assert "pseudo-likelihood" in of_usual
    assert "pseudo-likelihood" in of_windows


def test_observations_without_residuals_leave_their_cells_empty():
    table = observation_table({"observations": {"points": POINTS, "own": OWN}})
    assert table.groups[0][1] == [
        ["points", "pairs of points", "24", "1.10", "−3.00"],
        ["own", "an observation of your own", "–", "–", "−0.500"],
    ]
    assert observation_table({}) is None
