"""The nested balls as fixtures."""

import pytest

from bayesreg.io.domain import domain_labels, mesh_domain
from tests.io.balls import balls, grid


@pytest.fixture(scope="session")
def phantom():
    """Tissue labels and intracranial mask."""
    return balls(grid())


@pytest.fixture(scope="session")
def labels(phantom):
    """Tissue labels of the region to be meshed."""
    return domain_labels(phantom[0], mesh_domain(*phantom))
