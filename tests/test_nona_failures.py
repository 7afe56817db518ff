"""Runs of nona that fail: what is told of them."""

from __future__ import annotations

import pytest
import tifffile

from hugin_abflow.errors import ImageReadError, LayersMismatchError, NonaFailedError, ProjectError
from hugin_abflow.nona import open_layers
from hugin_abflow.project import read_plan


def test_photo_is_none(make_project, nona):
    """Nona does not say which."""
    plan = read_plan(make_project())
    plan.images[2].photo.write_bytes(b"no photo")
    with pytest.raises(ImageReadError, match=f"{plan.images[2].photo.name} is no image"), open_layers(plan):
        pass


def test_photo_of_another_size(make_project, nona):
    """Exported again; the aligned one is gone."""
    plan = read_plan(make_project())
    photo = plan.images[1].photo
    tifffile.imwrite(photo, tifffile.imread(photo)[::2, ::2], photometric="rgb")
    said = rf"{photo.name} has 102x76 pixels, in .*pano\.pto it has 203x151"
    with pytest.raises(ProjectError, match=said), open_layers(plan):
        pass


def test_canvas_that_hugin_makes_lower(make_project, nona):
    """A general Panini of such a view is not as high as the project says."""
    panorama = 'f19 w600 h400 v319 k0 E0 R0 P"100 0 0" n"TIFF_m c:LZW r:CROP"'
    plan = read_plan(make_project(panorama=panorama))
    with (
        pytest.raises(LayersMismatchError, match="600x400, of which Hugin makes 600x307"),
        open_layers(plan),
    ):
        pass


def test_nona_without_memory(make_project, tmp_path, monkeypatch):
    program_file = tmp_path / "nona"
    program_file.write_text('#!/bin/sh\necho "what():  std::bad_alloc"\nkill -6 $$\n')
    program_file.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with (
        pytest.raises(NonaFailedError, match=r"(?s)SIGABRT.* close other programs.*std::bad_alloc") as error,
        open_layers(read_plan(make_project())),
    ):
        pass
    assert "TMPDIR" not in str(error.value)
