"""The registry of similarities."""

from __future__ import annotations

from typing import get_args

import bayesreg as br
from bayesreg.model.observations.images.similarity import SIMILARITIES


def test_the_options_name_the_similarities_that_there_are():
    assert get_args(br.ModelConfig.model_fields["similarity"].annotation) == tuple(SIMILARITIES)
