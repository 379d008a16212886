"""The present densities against those of the code before the reshaping, at the same random states."""

from __future__ import annotations

import numpy as np
import pytest

from tests.model.reference_densities import CASES, FILE, densities, posterior_of_case

# Factors as they are now, and those of the former code that they are the products of.
FORMER = {
    "images": ("log_similarity", "log_similarity_normaliser"),
    "elastic": ("log_elastic", "log_normaliser"),
    "rigid": ("log_rigid",),
    "skull": (),
    "support": ("log_support",),
    "solved": ("log_solved",),
}


def former(name):
    if name.startswith("prior_"):
        return (f"log_{name}",)
    return FORMER.get(name, (name,))


@pytest.mark.parametrize("case", CASES)
def test_densities_gradients_and_energies_are_those_of_the_former_code(case):
    with np.load(FILE) as file:
        expected = {name.removeprefix(f"{case}/"): file[name] for name in file.files if name.startswith(f"{case}/")}
    arrays = densities(posterior_of_case(case), case)
    difference = np.linalg.norm(arrays["gradient"] - expected["gradient"], axis=1)
    assert (difference < 1e-6 * np.linalg.norm(expected["gradient"], axis=1)).all()
    for name in set(arrays) - {"gradient"}:
        sum_of_former = sum(expected[term] for term in former(name) if term in expected)
        np.testing.assert_allclose(arrays[name], sum_of_former, rtol=1e-9, atol=1e-12, err_msg=name)
    left_out = set(expected) - {term for name in arrays for term in former(name)}
    assert all((expected[name] == 0).all() for name in left_out), left_out
