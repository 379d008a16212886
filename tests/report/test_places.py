import numpy as np

from bayesreg.mesh import TetMesh
from bayesreg.report.places import regions
from bayesreg.tissues import label_of


def test_sides_follow_the_axes_and_the_tissue_is_the_nearest():
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10.0]])
    points = np.concatenate([corners, np.array([100, 60, 40]) - corners])
    cells = np.array([[0, 1, 2, 3], [4, 5, 7, 6]])
    mesh = TetMesh.from_arrays(points, cells, np.array([0, 2]), ("csf", "gm", "ventricle"))
    places = np.array([[50, 30, 20], [99, 30, 20], [5, 3, 2], [60, 29, 39], [45, 50, 21.0]])
    assert regions(mesh, places[1:]) == [
        "right, ventricle",
        "left posterior inferior, CSF",
        "right superior, ventricle",
        "anterior, ventricle",
    ]
    assert regions(mesh, places[:1])[0].startswith("central, ")
    assert regions(mesh, np.zeros((0, 3))) == []


def test_abbreviations_are_capitals():
    assert [label_of(name) for name in ("wm", "tumour")] == ["WM", "tumour"]
