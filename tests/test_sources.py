"""What a run was made of is known by its content, a series in a folder, too."""

import pytest

import bayesreg as br
from bayesreg.workflow.sources import digests_of_sources, require_same_sources


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_another_content_is_told_and_what_is_gone_is_not(tmp_path, kind):
    fixed, moving = tmp_path / "fixed.nii.gz", tmp_path / "moving"
    fixed.write_bytes(b"1")
    content_file = moving
    if kind == "folder":
        moving.mkdir()
        content_file = moving / "slice.dcm"
    content_file.write_bytes(b"2")
    (tmp_path / "run.yaml").write_text("data: {source: files, fixed: fixed.nii.gz, moving: moving}")
    config = br.load_config(tmp_path / "run.yaml")
    digests = digests_of_sources(config, ())
    assert sorted(digests) == ["data.fixed", "data.moving"]
    fixed.unlink()
    require_same_sources(config, digests, (), tmp_path)
    content_file.write_bytes(b"3")
    with pytest.raises(br.InputError, match=r"^data\.moving \(.*moving\) has changed"):
        require_same_sources(config, digests, (), tmp_path)
