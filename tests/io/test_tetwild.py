"""fTetWild in its own process, and the cells that it leaves out."""

import numpy as np
import pytest

from bayesreg.io import tetwild
from bayesreg.io.domain import MeshError
from bayesreg.io.surfaces import depth_sizing, smoothed_region, tissue_surfaces
from bayesreg.mesh import TetMesh
from tests.io.balls import balls, grid


@pytest.fixture(scope="module")
def task():
    labels, _ = balls(grid((3.0, 3.0, 3.0)))
    return tissue_surfaces(labels, 20.0), smoothed_region(labels, 20.0), depth_sizing(labels, 20.0, 30.0)


class TestTetrahedralize:
    def test_leaves_neither_files_nor_words_behind(self, task, tmp_path, monkeypatch, capfd):
        monkeypatch.chdir(tmp_path)
        points, cells = tetwild.tetrahedralize(*task, envelope=5.0, threads=1)
        assert (TetMesh.from_arrays(points, cells, np.zeros(len(cells), int)).volumes > 0).all()
        assert not list(tmp_path.iterdir())
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize(
        ("program", "message"),
        [
            ("import sys; sys.exit('out of luck')", r"failed \(exit 1: out of luck\)"),
            ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", r"failed \(exit -11: no message\)"),
            (
                "import numpy as np; np.savez('out.npz', points=np.zeros((0, 3)), cells=np.zeros((0, 4), int))",
                "returned an empty mesh",
            ),
        ],
        ids=["error", "crash", "nothing"],
    )
    def test_says_what_went_wrong(self, task, monkeypatch, program, message):
        monkeypatch.setattr(tetwild, "_PROGRAM", program)
        with pytest.raises(MeshError, match=message):
            tetwild.tetrahedralize(*task, envelope=5.0)
