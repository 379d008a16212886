"""A run with a surface alone, from a configuration to its results."""

from __future__ import annotations

import numpy as np
import pytest

import bayesreg as br
from tests.phantoms import box_mesh, of_one_tissue

RUN = """
data: {source: files}
mesh: {file: mesh.vtu}
observations: [{kind: surface, file: top.csv, sd: 0.3}]
model: {elasticity: uniform, fixed: {lam: 2.0, mu: 1.0}, rigid_sd: 0.3}
sampler: {chains: 2, warm_up: 10}
"""


@pytest.mark.long
def test_a_resumed_run_with_a_surface_is_the_run_that_was_not_cut_off(tmp_path):
    mesh, rng = of_one_tissue(box_mesh(3)), np.random.default_rng(0)
    br.save_mesh(mesh, tmp_path / "mesh.vtu")
    points = np.c_[rng.uniform(4, 16, (60, 2)), mesh.points[:, 2].max() + rng.normal(0.5, 0.3, 60)]
    np.savetxt(tmp_path / "top.csv", points, delimiter=",", header="x,y,z", comments="")
    (tmp_path / "run.yaml").write_text(RUN)
    whole, first, second = (br.load_config(tmp_path / "run.yaml", [f"stop.max_steps={n}"]) for n in (50, 25, 50))
    at_once = br.run(whole, out=tmp_path / "whole", progress=False).idata.posterior
    br.run(first, out=tmp_path / "parts", progress=False)
    in_parts = br.run(second, out=tmp_path / "parts", resume=True, progress=False).idata.posterior
    assert at_once.sizes["draw"] == in_parts.sizes["draw"] == 50
    for name in ("body_load", "u_boundary"):
        np.testing.assert_allclose(at_once[name], in_parts[name], rtol=1e-6, atol=1e-8)
