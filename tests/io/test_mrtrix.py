"""MRtrix's images, against files that its own mrconvert has written of one NIfTI image."""

import base64
import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayesreg.image import Image
from bayesreg.io.volumes import load_image, load_labels, load_mask, save_image
from bayesreg.types import InputError

# The image of which they were made.
VOXELS = np.arange(24).reshape(2, 3, 4)
AFFINE = np.eye(4)
AFFINE[:3, :3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix() @ np.diag([1.5, 2, 3])
AFFINE[:3, 3] = -5, 7, 11

# mrconvert (3.0.3) -strides -2,3,-1
BACKWARDS = base64.b64decode("""
bXJ0cml4IGltYWdlCmRpbTogMiwzLDQKdm94OiAxLjUsMiwzCmxheW91dDogLTEsKzIsLTAKZGF0
YXR5cGU6IEludDE2TEUKdHJhbnNmb3JtOiAwLjgxMzc5NzY4MjA3MDA3NiwgLTAuNDQwOTY5NjEx
OTI0MDAyLCAwLjM3ODUyMjMyNTQyNzExOSwgLTUKdHJhbnNmb3JtOiAwLjQ2OTg0NjMxMDYzMTI3
NCwgMC44ODI1NjQxMTg5Mzc4MDUsIDAuMDE4MDI4MzExODUxMTIyOSwgNwp0cmFuc2Zvcm06IC0w
LjM0MjAyMDE0MTI4MzQ1LCAwLjE2MzE3NTkwOTEzODM2NSwgMC45MjU0MTY1NzA1OTEzNDUsIDEx
CmNvbW1hbmRfaGlzdG9yeTogbXJjb252ZXJ0IC1xdWlldCBhLm5paSBhLm1pZiAtc3RyaWRlcyAn
LTIsMywtMScgLWZvcmNlICAodmVyc2lvbj0zLjAuMykKbXJ0cml4X3ZlcnNpb246IDMuMC4zCmZp
bGU6IC4gNDI0CkVORAoAAAAAAAAAAAAAAA8ADgANAAwAAwACAAEAAAATABIAEQAQAAcABgAFAAQA
FwAWABUAFAALAAoACQAIAA==
""")
# mrconvert -datatype bit -strides 2,1,3
BITS = base64.b64decode("""
bXJ0cml4IGltYWdlCmRpbTogMiwzLDQKdm94OiAxLjUsMiwzCmxheW91dDogKzEsKzAsKzIKZGF0
YXR5cGU6IEJpdAp0cmFuc2Zvcm06IDAuODEzNzk3NjgyMDcwMDc2LCAtMC40NDA5Njk2MTE5MjQw
MDIsIDAuMzc4NTIyMzI1NDI3MTE5LCAtNQp0cmFuc2Zvcm06IDAuNDY5ODQ2MzEwNjMxMjc0LCAw
Ljg4MjU2NDExODkzNzgwNSwgMC4wMTgwMjgzMTE4NTExMjI5LCA3CnRyYW5zZm9ybTogLTAuMzQy
MDIwMTQxMjgzNDUsIDAuMTYzMTc1OTA5MTM4MzY1LCAwLjkyNTQxNjU3MDU5MTM0NSwgMTEKY29t
bWFuZF9oaXN0b3J5OiBtcmNvbnZlcnQgLXF1aWV0IGEubmlpIGUubWlmIC1kYXRhdHlwZSBiaXQg
LWZvcmNlIC1zdHJpZGVzICcyLDEsMycgICh2ZXJzaW9uPTMuMC4zKQptcnRyaXhfdmVyc2lvbjog
My4wLjMKZmlsZTogLiA0MzIKRU5ECgAAAAAAAAAAAAAAf///
""")


def check(path, voxels=VOXELS):
    found = load_image(path)
    np.testing.assert_array_equal(found.voxels, voxels)
    np.testing.assert_allclose(found.affine, AFFINE, atol=1e-6)


def test_axes_in_another_order_and_backwards(tmp_path):
    (tmp_path / "image.mif").write_bytes(BACKWARDS)
    check(tmp_path / "image.mif")
    (tmp_path / "image.mif.gz").write_bytes(gzip.compress(BACKWARDS))
    check(tmp_path / "image.mif.gz")


def test_bits_are_a_mask(tmp_path):
    (tmp_path / "mask.mif").write_bytes(BITS)
    check(tmp_path / "mask.mif", VOXELS != 0)
    assert load_mask(tmp_path / "mask.mif").voxels.sum() == 23


def test_voxels_in_a_file_of_their_own_with_a_scaling(tmp_path):
    header, _, voxels = BACKWARDS.partition(b"\nEND\n")
    begin = len(BACKWARDS) - 48
    assert voxels[-48:] == BACKWARDS[begin:]
    (tmp_path / "image.dat").write_bytes(BACKWARDS[begin:])
    own = header.replace(b"file: . 424", b"scaling: 10,0.5\nENDOSCOPY: no\nfile: image.dat") + b"\n"
    (tmp_path / "image.mih").write_bytes(own)
    check(tmp_path / "image.mih", 10 + 0.5 * VOXELS)
    for name, part in (
        ("my first.dat", BACKWARDS[begin : begin + 20]),
        ("my second.dat", b"xx" + BACKWARDS[begin + 20 :]),
    ):
        (tmp_path / name).write_bytes(part)
    parts = own.replace(b"file: image.dat", b"file: my first.dat\nfile: my second.dat 2").replace(
        b"Int16LE", b"int16le"
    )
    (tmp_path / "parts.mih").write_bytes(parts)
    check(tmp_path / "parts.mih", 10 + 0.5 * VOXELS)


def test_numbers_that_begin_with_the_greatest_byte(tmp_path):
    voxels = np.frombuffer(BACKWARDS[-48:], "<i2").astype(">f4").tobytes()
    header = BACKWARDS[:-48].replace(b"Int16LE", b"Float32BE").replace(b"file: . 424", b"file: . 426")
    (tmp_path / "image.mif").write_bytes(header + voxels)
    check(tmp_path / "image.mif")


def test_labels_lie_where_those_of_nifti_do(tmp_path):
    save_image(Image(VOXELS.astype(np.int16), AFFINE), tmp_path / "labels.nii")
    (tmp_path / "labels.mif").write_bytes(BACKWARDS)
    table = {"low": list(range(1, 12)), "high": list(range(12, 24))}
    one, other = (load_labels(tmp_path / f"labels.{suffix}", table) for suffix in ("nii", "mif"))
    np.testing.assert_array_equal(one.voxels, other.voxels)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BACKWARDS[:-2], "cut short: 23 of 24 voxels"),
        (BACKWARDS[:300], "its header lacks 'file'"),
        (b"mrtrix tracks\nEND\n", "does not begin as MRtrix's images do"),
        (BACKWARDS.replace(b"Int16LE", b"CFloat32LE"), "its voxels are CFloat32LE"),
        (BACKWARDS.replace(b"-1,+2,-0", b"-1,+1,-0"), "the layout"),
        (BACKWARDS.replace(b"dim: 2,3,4", b"dim: 2,x,4"), "its header or content is damaged"),
        (BACKWARDS.replace(b"file: . 424", b"file: . 4"), "within the header"),
        (BACKWARDS.replace(b"file: . 424", b"file: elsewhere"), "elsewhere"),
    ],
)
def test_what_is_damaged_is_told(tmp_path, content, message):
    (tmp_path / "image.mif").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_image(tmp_path / "image.mif")


def test_a_damaged_compression_is_told(tmp_path):
    (tmp_path / "image.mif.gz").write_bytes(gzip.compress(BACKWARDS)[:-20])
    with pytest.raises(InputError, match="cannot be read"):
        load_image(tmp_path / "image.mif.gz")
