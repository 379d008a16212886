"""Whatever a file holds, it is read, or refused in one message: configurations, and headers of every format.

The long versions have ten times as many examples, and tell those that took longest.
"""

from __future__ import annotations

import io
import json
import logging
import time
from contextlib import suppress
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import pyvista
import SimpleITK
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.config import ConfigError, resolved_yaml
from bayesreg.io.fields import load_displacement
from bayesreg.io.points import read_points
from bayesreg.io.surface_files import read_surface
from bayesreg.io.transforms import save_transform
from bayesreg.messages import from_level
from bayesreg.pose import Pose
from bayesreg.types import InputError
from tests.phantoms import box_mesh

ROOT = Path(__file__).parent.parent
CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))
SLOWEST = 5.0


def fuzz(examples):
    checks = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
    return settings(max_examples=examples, deadline=None, suppress_health_check=checks, derandomize=True)


NASTY = {
    "an anchor that holds itself": "a: &a\n  b: *a\n",
    "a list that holds itself": "a: &a [*a]\n",
    "deep lists": "a: " + "[" * 3000 + "]" * 3000,
    "deep keys": "".join("  " * k + f"k{k}:\n" for k in range(500)),
    "a number of 5,000 digits": "seed: " + "9" * 5000,
    "a date of a thirteenth month": "seed: 2026-13-01",
    "a tag": "seed: !!int x",
    "a tag of Python": "seed: !!python/object/apply:os.system [ls]",
    "a long path": "data: {source: files, fixed: '" + "x" * 5000 + "', moving: y}",
    "many keys": "\n".join(f"k{k}: 1" for k in range(20_000)),
    "a thousand laughs": "a: &a [1,1,1,1,1,1,1,1,1]\n"
    + "".join(f"{chr(98 + k)}: &{chr(98 + k)} [{','.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(8)),
    "a list as a key": "? [a, b]\n: 1",
    "a null byte": "seed: \0",
    "half a character": 'description: "\\ud800"',
    "a line separator": 'description: "a\\u0085b"',
    "two documents": "---\na: 1\n---\nb: 2",
    "a thousand million chains": "data: {source: mni152}\nsampler: {name: rwmh, chains: 1000000000}",
}


@pytest.mark.parametrize("name", NASTY)
def test_what_has_broken_something_is_one_message(name, tmp_path):
    (tmp_path / "run.yaml").write_text(NASTY[name], encoding="utf-8", errors="surrogatepass")
    with pytest.raises(ConfigError):
        br.load_config(tmp_path / "run.yaml")
    with pytest.raises(ConfigError):
        br.load_config(ROOT / "configs" / "quickstart.yaml", [f"seed={NASTY[name]}"])


def test_a_chain_of_files_that_extend_one_another_ends(tmp_path):
    for k in range(1500):
        (tmp_path / f"{k}.yaml").write_text(f"extends: {k + 1}.yaml\n")
    with pytest.raises(ConfigError, match="extends a file that extends another"):
        br.load_config(tmp_path / "0.yaml")
    with pytest.raises(ConfigError, match="a path of more than"):
        br.load_config(CONFIGS[0], [".".join("a" * 1500) + "=1"])


SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=30), st.dates(), st.binary(max_size=9),
    st.sampled_from(["", "~", "1e999", "-0", "0x1F", "yes", ".inf", "..", "/", "%", "$x_{$", "\u2028", "é", "true"]),
)  # fmt: skip
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4)
)


def _paths(data, path=()):
    yield path
    if isinstance(data, dict):
        for key, value in data.items():
            yield from _paths(value, (*path, key))


@st.composite
def configurations(draw):
    """A configuration with some values, keys or characters changed."""
    text = draw(st.sampled_from(CONFIGS)).read_text(encoding="utf-8")
    data = YAML(typ="safe", pure=True).load(text)
    for _ in range(draw(st.integers(0, 4))):
        *above, last = draw(st.sampled_from(list(_paths(data))[1:] or [("seed",)]))
        section = data
        for key in above:
            section = section[key] if isinstance(section, dict) else section
        if isinstance(section, dict):
            if draw(st.booleans()):
                section[last] = draw(VALUES)
            else:
                section[draw(st.text(max_size=9) | st.sampled_from(["seed", "stop", "observations"]))] = draw(VALUES)
    try:
        written = io.StringIO()
        YAML(typ="safe", pure=True).dump(data, written)
        text = written.getvalue()
    except Exception:
        # What cannot be written as YAML is no file.
        pass
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, len(text)))
        text = text[:place] + draw(st.text(max_size=4)) + text[place + draw(st.integers(0, 4)) :]
    return text


def _load(folder, text):
    path = folder / "run.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    began = time.perf_counter()
    with suppress(InputError):
        config = br.load_config(path)
        # What is accepted reads back.
        written = resolved_yaml(config)
        (folder / "resolved.yaml").write_text(written, encoding="utf-8")
        assert resolved_yaml(br.load_config(folder / "resolved.yaml")) == written
    return time.perf_counter() - began


@fuzz(200)
@given(text=configurations())
@pytest.mark.long
def test_configurations_are_read_or_refused(tmp_path, text):
    _load(tmp_path, text)


@pytest.mark.long
@fuzz(2000)
@given(text=configurations())
def test_many_configurations_are_read_or_refused_at_once(tmp_path, text):
    assert _load(tmp_path, text) < SLOWEST


def _volume(path):
    voxels = np.random.default_rng(0).normal(size=(5, 6, 7)).astype(np.float32)
    affine = np.diag([2.0, 2.0, 3.0, 1.0])
    if path.suffix in (".nrrd", ".mha"):
        SimpleITK.WriteImage(SimpleITK.GetImageFromArray(voxels), str(path))
    elif path.suffix == ".mgz":
        nib.save(nib.MGHImage(voxels, affine), path)
    else:
        nib.save(nib.Nifti1Image(voxels, affine), path)


def _mesh(path):
    br.save_mesh(box_mesh(1), path)


def _surface(path):
    pyvista.Sphere(theta_resolution=6, phi_resolution=6).save(path)


def _points(path):
    text = {
        ".csv": "name,x,y,z\na,1,2,3\nb,4,5,6\n",
        ".fcsv": "# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n1,1,2,3,a\n2,4,5,6,b\n",
        ".json": json.dumps(
            {"markups": [{"coordinateSystem": "LPS", "controlPoints": [{"label": "a", "position": [1, 2, 3]}]}]}
        ),
        ".tag": 'MNI Tag Point File\nVolumes = 1;\nPoints =\n 1 2 3 "a"\n 4 5 6 "b";\n',
    }
    path.write_text(text[path.suffix])


def _field(path):
    if path.suffix == ".h5":
        grid = br.Image(np.zeros((4, 5, 6)), np.eye(4))
        save_transform(path, np.zeros((*grid.shape, 3)), grid, Pose.identity())
    else:
        vectors = nib.Nifti1Image(np.zeros((4, 5, 6, 1, 3), np.float32), np.eye(4))
        vectors.header.set_intent(1007)
        nib.save(vectors, path)


# How a sound file of each name is written, and by what it is read.
FORMATS = {
    "a.nii": (_volume, br.load_image),
    "a.nii.gz": (_volume, br.load_image),
    "a.mgz": (_volume, br.load_image),
    "a.nrrd": (_volume, br.load_image),
    "a.mha": (_volume, br.load_image),
    "a.vtu": (_mesh, br.load_mesh),
    "a.vtk": (_surface, read_surface),
    "a.vtp": (_surface, read_surface),
    "a.obj": (_surface, read_surface),
    "a.stl": (_surface, read_surface),
    "a.ply": (_surface, read_surface),
    "a.csv": (_points, read_points),
    "a.fcsv": (_points, read_points),
    "a.mrk.json": (_points, read_points),
    "a.tag": (_points, read_points),
    "a.h5": (_field, load_displacement),
    "b.nii.gz": (_field, load_displacement),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The bytes of a sound file of each format, which are read without an error."""
    folder, contents = tmp_path_factory.mktemp("sound"), {}
    for name, (write, read) in FORMATS.items():
        write(folder / name)
        read(folder / name)
        contents[name] = (folder / name).read_bytes()
    return contents


@st.composite
def damages(draw):
    """A format, and what is done to its bytes: some are changed, mostly at the beginning, or the end is cut off."""
    name = draw(st.sampled_from(sorted(FORMATS)))
    reach = draw(st.sampled_from([60, 400, 10_000]))
    changes = draw(st.lists(st.tuples(st.integers(0, reach), st.integers(0, 255)), min_size=1, max_size=8))
    inserted = draw(st.binary(max_size=6))
    return name, changes, inserted, draw(st.none() | st.floats(0, 1))


def _spoil(content, changes, inserted, cut):
    spoilt = bytearray(content)
    for place, value in changes:
        spoilt[place % len(spoilt)] = value
    if inserted:
        place = changes[0][0] % len(spoilt)
        spoilt[place:place] = inserted
    return bytes(spoilt if cut is None else spoilt[: int(cut * len(spoilt))])


def _read(folder, sound, damage):
    name, *how = damage
    path = folder / name
    path.write_bytes(_spoil(sound[name], *how))
    began = time.perf_counter()
    with from_level(logging.CRITICAL), suppress(InputError):
        FORMATS[name][1](path)
    return time.perf_counter() - began


@fuzz(200)
@given(damage=damages())
def test_damaged_files_are_read_or_refused(tmp_path, sound, damage):
    _read(tmp_path, sound, damage)


@pytest.mark.long
@fuzz(2000)
@given(damage=damages())
def test_many_damaged_files_are_read_or_refused_at_once(tmp_path, sound, damage):
    assert _read(tmp_path, sound, damage) < SLOWEST
