"""Points and pairs of points from the files that users have."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import bayesreg as br
from bayesreg.io.point_formats import PointPairs
from bayesreg.io.points import read_point_pairs, read_points

PLACES = np.array([[1.0, -2.0, 3.0], [4.5, 5.0, -6.0]])
MOVED = PLACES + np.array([0.5, 0.0, -1.0])


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


def fcsv(system, points, labels=("a", "b")):
    rows = "".join(
        f"id{i},{x},{y},{z},0,0,0,1,1,1,0,{n},,\n" for i, ((x, y, z), n) in enumerate(zip(points, labels, strict=True))
    )
    columns = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    return f"# Markups fiducial file version = 4.11\n# CoordinateSystem = {system}\n{columns}{rows}"


def markups(system, points, labels=("a", "b"), **more):
    control = [
        {"label": n, "position": list(p), "positionStatus": "defined"} for p, n in zip(points, labels, strict=True)
    ]
    control.append({"label": "planned", "position": [0, 0, 0], "positionStatus": "undefined"})
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": system, "controlPoints": control, **more}]})


LPS = PLACES * [-1, -1, 1]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("p.csv", "name,x,y,z\na,1,-2,3\nb,4.5,5,-6\n"),
        ("p.csv", "\ufeffx , y,z,Name\n# a comment\n1,-2,3,a\n\n4.5,5,-6,b\n"),
        ("p.csv", "# CoordinateSystem = LPS\nname,x,y,z\na,-1,2,3\nb,-4.5,-5,-6\n"),
        ("p.csv", "# coordinatesystem: lps\nname,x,y,z\na,-1,2,3\nb,-4.5,-5,-6\n"),
        ("p.fcsv", fcsv("RAS", PLACES)),
        ("p.fcsv", fcsv("0", PLACES)),
        ("p.fcsv", fcsv("LPS", LPS)),
        ("p.fcsv", fcsv("1", LPS)),
        ("p.mrk.json", markups("RAS", PLACES)),
        ("p.mrk.json", markups("LPS", LPS, coordinateUnits="mm")),
        ("P.TAG", 'MNI Tag Point File\nVolumes = 1;\n% seen\nPoints =\n 1 -2 3 "a"\n 4.5 5 -6 1 1 1 "b";\n'),
        ("p.tag", 'MNI Tag Point File\nVolumes = 1;\nPoints =\n 1 -2 3 1 0 7 "a"\n 4.5 5 -6 "b"\n;\n'),
        ("p.csv", "name,x,y,z,,\na,1,-2,3,,\nb,4.5,5,-6,,\n"),
    ],
)
def test_points_are_read_in_ras(tmp_path, name, text):
    point_set = read_points(written(tmp_path, name, text))
    np.testing.assert_allclose(point_set.points, PLACES)
    assert point_set.names == ("a", "b")
    assert point_set.sd is None


def test_a_label_may_hold_what_ends_a_tag_file(tmp_path):
    text = 'MNI Tag Point File\nVolumes = 1;\nPoints =\n 1 -2 3 "a;b % c"\n 4.5 5 -6 % last\n;\n'
    point_set = read_points(written(tmp_path, "p.tag", text))
    np.testing.assert_allclose(point_set.points, PLACES)
    assert point_set.names == ("a;b % c", "")


def test_pairs_of_a_csv_may_be_lps(tmp_path):
    header = "# CoordinateSystem = LPS\nfixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z\n"
    pairs = read_point_pairs(written(tmp_path, "p.csv", header + "1,2,3,4,5,6\n"))
    np.testing.assert_allclose(pairs.fixed, [[-1, -2, 3]])
    np.testing.assert_allclose(pairs.moving, [[-4, -5, 6]])


def test_pairs_from_one_file(tmp_path):
    rows = "".join(",".join(map(str, [*p, *q, 0.5])) + "\n" for p, q in zip(PLACES, MOVED, strict=True))
    path = written(tmp_path, "p.csv", "fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z,sd\n" + rows)
    pairs = read_point_pairs(path)
    np.testing.assert_allclose(pairs.fixed, PLACES)
    np.testing.assert_allclose(pairs.moving, MOVED)
    np.testing.assert_allclose(pairs.sd, 0.5)
    rows = "".join(" " + " ".join(map(str, [*p, *q])) + ' ""\n' for p, q in zip(PLACES, MOVED, strict=True))
    pairs = read_point_pairs(written(tmp_path, "p.tag", f"MNI Tag Point File\nVolumes = 2;\nPoints =\n{rows};\n"))
    np.testing.assert_allclose(pairs.moving, MOVED)
    with pytest.raises(br.InputError, match="expected points of one space"):
        read_points(path)


def test_pairs_from_two_files_go_by_name_or_by_order(tmp_path):
    first = written(tmp_path, "f.fcsv", fcsv("LPS", LPS))
    named = written(tmp_path, "m.mrk.json", markups("RAS", MOVED[::-1], labels=("b", "a")))
    np.testing.assert_allclose(read_point_pairs(first, named).moving, MOVED)
    unnamed = written(tmp_path, "m.csv", "x,y,z\n" + "".join(",".join(map(str, q)) + "\n" for q in MOVED))
    np.testing.assert_allclose(read_point_pairs(first, unnamed).moving, MOVED)
    with pytest.raises(br.InputError, match="give the points of the moving image"):
        read_point_pairs(first)
    moving_file = written(tmp_path, "o.fcsv", fcsv("RAS", MOVED, labels=("b", "c")))
    with pytest.raises(br.InputError, match="share some names only; 'a' stands in one of them"):
        read_point_pairs(first, moving_file)
    moving_file = written(tmp_path, "o.fcsv", fcsv("RAS", MOVED, labels=("m1", "m2")))
    np.testing.assert_allclose(read_point_pairs(first, moving_file).moving, MOVED)
    file_with_sd = written(tmp_path, "sd.csv", "x,y,z,sd\n1,2,3,1\n1,2,4,1\n")
    with pytest.raises(br.InputError, match=r"sd\.csv gives an sd; expected it in the file of the fixed points"):
        read_point_pairs(first, file_with_sd)
    file_of_one = written(tmp_path, "one.csv", "x,y,z\n1,2,3\n")
    with pytest.raises(br.InputError, match=r"holds 2 points and .*one\.csv 1"):
        read_point_pairs(first, file_of_one)


def test_moving_points_may_be_read_twice(tmp_path):
    again = MOVED + 0.25
    columns = ",".join(f"{side}_{axis}" for side in ("fixed", "moving", "second") for axis in "xyz")
    flipped = np.hstack([side * [-1, -1, 1] for side in (PLACES, MOVED, again)])
    rows = [f"{name}," + ",".join(map(str, row)) for name, row in zip("ab", flipped, strict=True)]
    whole = written(tmp_path, "p.csv", "\n".join(["# CoordinateSystem = LPS", "name," + columns, *rows]))
    np.testing.assert_allclose(read_point_pairs(whole).second, again)
    first = written(tmp_path, "f.fcsv", fcsv("LPS", LPS))
    moving = written(tmp_path, "m.mrk.json", markups("RAS", MOVED[::-1], labels=("b", "a")))
    named = written(tmp_path, "n.mrk.json", markups("RAS", again[::-1], labels=("b", "a")))
    unnamed = written(tmp_path, "s.csv", "x,y,z\n" + "".join(",".join(map(str, q)) + "\n" for q in again))
    for second in (named, unnamed):
        pairs = read_point_pairs(first, moving, second)
        np.testing.assert_allclose(pairs.second, again)
        np.testing.assert_allclose(PointPairs.of_arrays(pairs.as_arrays()).second, again)
    assert read_point_pairs(first, moving).second is None
    with pytest.raises(br.InputError, match="has the columns of a second reading; expected no second file"):
        read_point_pairs(whole, second=unnamed)
    with pytest.raises(br.InputError, match=r"holds 2 points and .*one\.csv 1"):
        read_point_pairs(first, moving, written(tmp_path, "one.csv", "x,y,z\n1,2,3\n"))
    part = written(tmp_path, "part.csv", columns.removesuffix(",second_z") + "\n1,2,3,4,5,6,7,8\n")
    with pytest.raises(br.InputError, match="second_x, second_y, second_z, or with x, y, z; got fixed_x"):
        read_point_pairs(part)
    bad = written(tmp_path, "bad.csv", columns + "\n1,2,3,4,5,6,7,8,nan\n")
    with pytest.raises(br.InputError, match="point 1 is not finite"):
        read_point_pairs(bad)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("p.txt", "1 2 3", r"unknown kind of file with points; known are \.csv"),
        ("p.csv", "", "is empty; expected a header"),
        ("p.csv", "1,2,3\n", "expected a header with fixed_x"),
        ("p.csv", "x,y,z\n1,2\n", "line 2: expected 3 columns, got 2"),
        ("p.csv", "x,y,z\n1,2,three\n", "line 2: expected a number, got 'three'"),
        ("p.csv", "x,y,z\n", "holds no point"),
        ("p.csv", "x,y,z\n1,2,nan\n", "point 1 is not finite"),
        ("p.csv", "x,y,z,sd\n1,2,3,0\n", "every sd must be a positive number of mm, got 0 at point 1"),
        ("p.csv", "x,y,z,sd\n1,2,3,1\n1,2,3,inf\n", "every sd must be a positive number of mm, got inf at point 2"),
        ("p.csv", "x,y,z,X\n1,2,3,4\n", "expected one column x; got x, y, z, X"),
        ("p.csv", "# CoordinateSystem = IJK\nx,y,z\n1,2,3\n", "unknown coordinate system 'IJK'"),
        ("p.csv", "# all points are LPS\nx,y,z\n1,2,3\n", "write it as '# CoordinateSystem = LPS'"),
        ("p.fcsv", "# columns = id,r,a,s\nq,1,2,3\n", "line 1: expected columns x, y, z; got id, r, a, s"),
        ("p.fcsv", "# columns = id,ow,x,y,z\nq,1,2,3\n", "line 2: expected 5 columns or more, got 4"),
        ("p.mrk.json", '{"markups": null}', "expected markups to be a list of JSON objects, got None"),
        ("p.mrk.json", '{"markups": [{"controlPoints": ["a"]}]}', "expected controlPoints to be a list"),
        ("p.mrk.json", '{"markups": [{"controlPoints": [{"position": [1, 2]}]}]}', "a position of three numbers"),
        ("p.fcsv", fcsv("IJK", PLACES), "unknown coordinate system 'IJK'"),
        ("p.fcsv", "id0,1,2\n", "line 1: expected four columns or more"),
        ("p.mrk.json", "{}", "no file of 3D Slicer's markups"),
        ("p.mrk.json", markups("LPS", LPS, coordinateUnits="voxel"), "expected coordinates in mm"),
        ("p.tag", "Points = 1 2 3;", "is no MNI tag file"),
        ("p.tag", "MNI Tag Point File\nVolumes = 2;\nPoints =\n 1 2 3;\n", "line 4: expected 6 coordinates"),
        (
            "p.tag",
            'MNI Tag Point File\nVolumes = 1;\n% a\nPoints =\n 1 2 x "";\n',
            "line 5: expected a number, got 'x'",
        ),
        (
            "p.tag",
            'MNI Tag Point File\nVolumes = 1;\nPoints =\n 1 2 3 "" 4 5 6 "";\n',
            "line 4: expected one point a line",
        ),
    ],
)
def test_what_is_wrong_is_told(tmp_path, name, text, message):
    with pytest.raises(br.InputError, match=message):
        read_points(written(tmp_path, name, text))


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(br.InputError, match="no such file with points"):
        read_points(tmp_path / "none.csv")


@pytest.mark.skipif("BAYESREG_DATA" not in os.environ, reason="BAYESREG_DATA does not name the folder of RESECT")
def test_resects_files_are_read():
    files = sorted(Path(os.environ["BAYESREG_DATA"], "resect").glob("*.tag"))
    if not files:
        pytest.skip("the folder that BAYESREG_DATA names has no resect/*.tag")
    assert len(files) == 12
    for path in files:
        pairs = read_point_pairs(path)
        rows = [line.split() for line in path.read_text().splitlines() if line.rstrip(";").rstrip().endswith('""')]
        np.testing.assert_allclose(np.hstack([pairs.fixed, pairs.moving]), [[float(x) for x in r[:6]] for r in rows])
        assert np.linalg.norm(pairs.moving - pairs.fixed, axis=1).max() < 25


def control_points(path: Path, places: dict[str, tuple[float, float, float] | None]) -> Path:
    control = [
        {"label": name, "position": list(place or (0, 0, 0)), "positionStatus": "defined" if place else "undefined"}
        for name, place in places.items()
    ]
    path.write_text(json.dumps({"markups": [{"coordinateSystem": "RAS", "controlPoints": control}]}))
    return path


@pytest.mark.parametrize("labels", [("a", "b", "c", "d"), ("F", "F", "F", "F")], ids=["by name", "in order"])
def test_a_point_without_a_position_is_left_out_with_its_partner(tmp_path, caplog, labels):
    control = [{"label": name, "position": [k, 0, 0]} for k, name in enumerate(labels)]
    for file, missing in (("fixed", 1), ("moving", 2)):
        points = [
            {**point, "positionStatus": "undefined"} if k == missing else point for k, point in enumerate(control)
        ]
        (tmp_path / f"{file}.mrk.json").write_text(
            json.dumps({"markups": [{"coordinateSystem": "RAS", "controlPoints": points}]})
        )
    pairs = read_point_pairs(tmp_path / "fixed.mrk.json", tmp_path / "moving.mrk.json")
    np.testing.assert_array_equal(pairs.fixed[:, 0], [0, 3])
    np.testing.assert_array_equal(pairs.moving[:, 0], [0, 3])
    assert f"left out with their partners: {labels[1]}" in caplog.text


def test_a_planned_point_that_stands_in_one_file_needs_no_partner(tmp_path):
    fixed = control_points(tmp_path / "f.mrk.json", {"a": (0, 0, 0), "b": (1, 0, 0), "planned": None})
    moving = control_points(tmp_path / "m.mrk.json", {"b": (1, 1, 0), "a": (0, 1, 0)})
    assert read_point_pairs(fixed, moving).names == ("a", "b")
    nothing = control_points(tmp_path / "n.mrk.json", {"a": None, "b": None, "c": (0, 0, 0)})
    other = control_points(tmp_path / "o.mrk.json", {"a": (0, 0, 0), "b": (0, 0, 0), "c": None})
    with pytest.raises(br.InputError, match="no pair of which both points have a position"):
        read_point_pairs(other, nothing)
