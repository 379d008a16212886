"""The present densities against those of the code before the reshaping, at the same random states."""

from __future__ import annotations

import numpy as np
import pytest

from tests.model.reference_densities import CASES, FILE, densities, posterior_of


@pytest.mark.parametrize("case", CASES)
def test_densities_gradients_and_energies_are_those_of_the_former_code(case):
    with np.load(FILE) as file:
        expected = {name.removeprefix(f"{case}/"): file[name] for name in file.files if name.startswith(f"{case}/")}
    found = densities(posterior_of(case), case)
    difference = np.linalg.norm(found["gradient"] - expected["gradient"], axis=1)
    assert (difference < 1e-6 * np.linalg.norm(expected["gradient"], axis=1)).all()
    assert set(found) == set(expected)
    for name in set(expected) - {"gradient"}:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, atol=1e-12, err_msg=name)
