"""Which layers are used: found, stale, named, kept."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import age, names_of, pixels_of, refuse, remap, same, to_make, whole

from hugin_abflow import nona as program
from hugin_abflow.errors import ImageReadError, LayersMissingError, OutputError, SettingsError
from hugin_abflow.images import write_image
from hugin_abflow.merge import merge_project
from hugin_abflow.project import read_plan
from hugin_abflow.settings import Settings
from hugin_abflow.supply import open_layers

pytestmark = pytest.mark.usefixtures("temporary")


# ------------------------------------------------------------------------------------ which are used


def test_nothing_stays_behind(make_project, nona, temporary):
    plan = read_plan(make_project())
    before = sorted(plan.folder.iterdir())
    with open_layers(plan) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
        pixels_of(layers)
    assert sorted(plan.folder.iterdir()) == before


def test_progress_counts_every_step_of_every_image(make_project, nona):
    phases = []

    @contextmanager
    def progress(phase, total):
        phases.append([phase, total, 0])

        def advance(units):
            phases[-1][2] += units

        yield advance

    with open_layers(read_plan(make_project(disabled=(1,))), progress=progress):
        pass
    assert phases == [["remap", 4, 4]]


def test_disabled_images_leave_gaps_in_the_names(make_project, nona):
    plan = read_plan(make_project(disabled=(0,), yaws=(0, 60, 120)))
    with open_layers(plan) as layers:
        assert names_of(layers) == ["pano0001.tif", "pano0002.tif"]


@pytest.mark.parametrize("prefix", ["pano", "photo 0 - photo 2"])
def test_layers_beside_the_project_are_found(make_project, nona, prefix, monkeypatch):
    plan = read_plan(make_project())
    remap(plan, prefix)
    monkeypatch.setattr(program, "_run", refuse)
    with open_layers(plan) as layers:
        assert names_of(layers) == [f"{prefix}{index:04d}.tif" for index in range(3)]
        assert layers[0].file.parent == plan.folder


def test_layers_named_as_another_project_are_its_own(make_project, nona, temporary):
    """Hugin names layers by the first and the last photo, which several projects may have in common."""
    plan = read_plan(make_project())
    remap(plan, "photo 0 - photo 2")
    other = plan.file.with_name("photo 0 - photo 2.pto")
    shutil.copy2(plan.file, other)
    with open_layers(plan) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
    with open_layers(read_plan(other), remap="never") as layers:
        assert names_of(layers) == [f"photo 0 - photo 2{index:04d}.tif" for index in range(3)]


def test_complete_layers_go_before_incomplete_ones(make_project, nona, monkeypatch):
    plan = read_plan(make_project())
    remap(plan, "pano", "-i", "1")
    remap(plan, "photo 0 - photo 2")
    monkeypatch.setattr(program, "_run", refuse)
    with open_layers(plan) as layers:
        assert layers[0].name == "photo 0 - photo 20000.tif"


def test_multilayer_file_is_found_but_a_panorama_of_that_name_is_not(make_project, nona, monkeypatch):
    plan = read_plan(make_project())
    write_image(plan.folder / "pano.tif", np.full((401, 802, 4), 255, np.uint8))
    with pytest.raises(LayersMissingError), open_layers(plan, remap="never"):
        pass
    remap(plan, "pano", "-m", "TIFF_multilayer")
    monkeypatch.setattr(program, "_run", refuse)
    with open_layers(plan) as layers:
        assert names_of(layers) == ["pano.tif[0]", "pano.tif[1]", "pano.tif[2]"]
        assert plan.default_output([layer.file for layer in layers]).name == "pano_abflow.tif"


def test_photos_named_like_layers_are_no_layers(make_project, nona, temporary):
    plan = read_plan(make_project(photo="pano{:04d}.tif"))
    with open_layers(plan) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
    with pytest.raises(OutputError, match=r"pano0000\.tif is a photo"), open_layers(plan, keep_layers=True):
        pass


def test_photos_of_disabled_images_are_no_layers(make_project, nona, temporary):
    project = make_project(photo="pano{:04d}.tif", disabled=(0,))
    (project.parent / "pano0001.tif").rename(project.parent / "first.tif")
    text = project.read_text().replace("pano0001", "first").replace("pano0002", "last")
    project.write_text(text.replace("pano0000", "pano0002").replace("last", "pano0000"))
    plan = read_plan(project)
    photo = plan.folder / "pano0002.tif"  # of the first image, named like the last one's layer
    before = photo.read_bytes()
    with open_layers(plan) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
    with pytest.raises(OutputError, match=r"pano0002\.tif is a photo"), open_layers(plan, keep_layers=True):
        pass
    assert photo.read_bytes() == before


def test_only_missing_layers_are_made(make_project, nona):
    plan = read_plan(make_project())
    remap(plan, "pano")
    expected = None
    with open_layers(plan) as layers:
        expected = pixels_of(layers)
    (plan.folder / "pano0001.tif").unlink()
    with open_layers(plan) as layers:
        assert names_of(layers) == ["pano0000.tif", "pano0001.tif", "pano0002.tif"]
        assert [layer.file.parent == plan.folder for layer in layers] == [True, False, True]
        assert same(pixels_of(layers), expected)
    with open_layers(plan, keep_layers=True) as layers:
        assert all(layer.file.parent == plan.folder for layer in layers)
    assert (plan.folder / "pano0001.tif").is_file()


@pytest.mark.parametrize("mode", ["auto", "never", "prefix"])
def test_an_image_that_misses_the_crop_needs_no_layer(make_project, nona, mode):
    """Image 1 looks away from the crop. Its photo may even be gone."""
    panorama = 'f2 w802 h401 v360 S300,500,100,300 n"TIFF_m c:LZW r:CROP"'
    plan = read_plan(make_project(yaws=(-10, 180, 10), panorama=panorama))
    with open_layers(plan) as layers:  # all are made
        assert names_of(layers) == ["pano0000.tif", "pano0002.tif"]
    remap(plan, "pano")
    plan.images[1].photo.unlink()
    options = {"prefix": "pano"} if mode == "prefix" else {"remap": mode}
    with open_layers(plan, **options) as layers:
        assert names_of(layers) == ["pano0000.tif", "pano0002.tif"]
        assert layers[0].file.parent == plan.folder


def test_no_image_in_the_crop(make_project, nona):
    plan = read_plan(make_project(yaws=(0,), panorama='f2 w802 h401 v360 S0,50,0,50 n"TIFF_m r:CROP"'))
    with (
        pytest.raises(LayersMissingError, match="no active image that shows anything"),
        open_layers(plan),
    ):
        pass


# ------------------------------------------------------------------------------------ stale layers


@pytest.mark.parametrize("left", [0, 4, 2000])
@pytest.mark.parametrize("prefix", ["pano", "photo 0 - photo 2"])
def test_layers_of_a_run_that_was_broken_off_are_made_again(
    make_project, nona, temporary, caplog, left, prefix
):
    """TIFF's directory comes last: of what is left nothing can be read."""
    plan = read_plan(make_project())
    remap(plan, prefix)
    cut = plan.folder / f"{prefix}0001.tif"
    whole = cut.read_bytes()
    assert len(whole) > 2000
    cut.write_bytes(whole[:left])
    assert to_make(plan) == (None, [0, 1, 2])
    with open_layers(plan) as layers:
        assert all(temporary in layer.file.parents for layer in layers)
    assert "cannot be read: all layers are made again" in caplog.text and f"{prefix}0001.tif" in caplog.text
    assert cut.read_bytes() == whole[:left]
    with open_layers(plan, keep_layers=True):
        pass
    assert to_make(plan) == ("pano", [])


@pytest.mark.parametrize("fault", ["broken", "stale"])
def test_whole_and_fresh_layers_go_before_others(make_project, nona, monkeypatch, fault):
    plan = read_plan(make_project())
    remap(plan, "pano")
    remap(plan, "photo 0 - photo 2")
    if fault == "broken":
        (plan.folder / "pano0001.tif").write_bytes(b"")
    else:
        age(plan.folder / "pano0001.tif", 60)
    monkeypatch.setattr(program, "_run", refuse)
    assert to_make(plan) == ("photo 0 - photo 2", [])
    with open_layers(plan) as layers:
        assert names_of(layers)[1] == "photo 0 - photo 20001.tif"


def test_whole_layers_go_before_complete_ones(make_project, nona):
    """One that is missing costs less to make than all."""
    plan = read_plan(make_project())
    remap(plan, "pano")
    remap(plan, "photo 0 - photo 2")
    (plan.folder / "pano0001.tif").write_bytes(b"")
    (plan.folder / "photo 0 - photo 20002.tif").unlink()
    assert to_make(plan) == ("photo 0 - photo 2", [2])
    with open_layers(plan) as layers:
        assert [layer.file.parent == plan.folder for layer in layers] == [True, True, False]


def test_layers_that_are_there_are_never_replaced_by_the_panorama(make_project, nona):
    """As nona's file of many pages, which has the panorama's name, where it is no longer whole."""
    plan = read_plan(make_project())
    remap(plan, "pano", "-m", "TIFF_multilayer")
    pages = plan.folder / "pano.tif"
    for left in (pages.read_bytes(), pages.read_bytes()[:-200]):
        pages.write_bytes(left)
        age(pages, 60)
        assert merge_project(plan.file, Settings(flow=False)).name.startswith("pano_abflow")
        assert pages.read_bytes() == left


@pytest.mark.parametrize("how", ["found", "named", "no nona"])
def test_layers_whose_pixels_are_broken_can_be_made_again(make_project, nona, monkeypatch, how):
    """They open, so that it shows only where they are decoded; whoever named them knows of no project's."""
    plan = read_plan(make_project())
    remap(plan, "pano")
    layer = plan.folder / "pano0001.tif"
    with layer.open("r+b") as file:
        file.seek(300)
        file.write(b"\0" * 1000)
    named = {"prefix": "pano"} if how == "named" else {}
    if how == "no nona":
        monkeypatch.setenv("PATH", "")
    with pytest.raises(ImageReadError) as error, open_layers(plan, **named) as layers:
        whole(layers[1])
    assert "pano0001.tif cannot be read (" in str(error.value)
    assert ("--remap always" in str(error.value)) == (how == "found")
    with pytest.raises(ImageReadError, match=r"^another$"), open_layers(plan):
        raise ImageReadError("another")


@pytest.mark.parametrize("without", ["photo", "nona"])
def test_broken_layers_that_cannot_be_made_again_are_told(make_project, nona, monkeypatch, caplog, without):
    plan = read_plan(make_project())
    remap(plan, "pano")
    (plan.folder / "pano0001.tif").write_bytes(b"")
    if without == "photo":
        plan.images[2].photo.unlink()
    else:
        monkeypatch.setenv("PATH", "")
    age(plan.folder / "pano0001.tif", 60)
    with pytest.raises(ImageReadError, match=r"pano0001\.tif cannot be read"), open_layers(plan):
        pass
    assert not caplog.text  # they are not "used as they are"


@pytest.mark.parametrize("older, stale", [(1.0, False), (3.0, True)])
@pytest.mark.parametrize("than", ["project", "photo"])
def test_layers_older_than_project_or_photo_are_made_again(make_project, nona, older, stale, than, temporary):
    plan = read_plan(make_project())
    remap(plan, "pano")
    for image in plan.images:
        age(image.photo, 100)
    age(plan.file, 100)
    newer = plan.file if than == "project" else plan.images[1].photo
    for index in range(3):
        age(plan.folder / f"pano{index:04d}.tif", 50)
    moment = (plan.folder / "pano0001.tif").stat().st_mtime + older
    os.utime(newer, (moment, moment))
    with open_layers(plan) as layers:
        assert [temporary in layer.file.parents for layer in layers] == [stale] * 3


@pytest.mark.parametrize("reason", ["photos are missing", "nona is not installed"])
def test_stale_layers_that_cannot_be_made_again_are_used_with_a_warning(
    make_project, nona, reason, caplog, monkeypatch
):
    plan = read_plan(make_project())
    remap(plan, "pano")
    age(plan.folder / "pano0000.tif", 60)
    if "photos" in reason:
        plan.images[2].photo.unlink()
    else:
        monkeypatch.setenv("PATH", "")
    with open_layers(plan) as layers:
        assert layers[0].file.parent == plan.folder
    assert "pano0000.tif is older" in caplog.text and reason in caplog.text


def test_never_uses_what_is_there_and_says_what_is_wrong(make_project, nona, caplog):
    plan = read_plan(make_project())
    remap(plan, "pano")
    age(plan.folder / "pano0000.tif", 60)
    (plan.folder / "pano0002.tif").unlink()
    with open_layers(plan, remap="never") as layers:
        assert names_of(layers) == ["pano0000.tif", "pano0001.tif"]
    assert "no layer of image 2 (photo 2.tif)" in caplog.text
    assert "pano0000.tif is older" in caplog.text


def test_never_without_layers(make_project):
    with (
        pytest.raises(LayersMissingError, match=r"pano0000\.tif .* or photo 0 - photo 20000\.tif"),
        open_layers(read_plan(make_project()), remap="never"),
    ):
        pass


def test_always_makes_fresh_layers_too(make_project, nona, temporary):
    plan = read_plan(make_project())
    remap(plan, "pano")
    with open_layers(plan, remap="always") as layers:
        assert all(temporary in layer.file.parents for layer in layers)


# ------------------------------------------------------------------------------------ named layers


@pytest.mark.parametrize("where", ["here", "project's folder", "absolute", "folder"])
def test_prefix_is_looked_up_here_and_beside_the_project(make_project, nona, where, monkeypatch, tmp_path):
    plan = read_plan(make_project())
    remap(plan, "my layer_")
    for index in range(3):
        age(plan.folder / f"my layer_{index:04d}.tif", 1000)  # taken as they are
    prefix = "my layer_"
    if where == "here":
        monkeypatch.chdir(plan.folder)
    elif where == "absolute":
        prefix = str(plan.folder / prefix)
    elif where == "folder":
        (plan.folder / "sub").mkdir()
        for index in range(3):
            (plan.folder / f"my layer_{index:04d}.tif").rename(plan.folder / "sub" / f"{index:04d}.tif")
        prefix = "sub/"
    monkeypatch.setattr(program, "_run", refuse)
    with open_layers(plan, prefix=prefix) as layers:
        assert len(layers) == 3


def test_prefix_that_lacks_a_layer_says_so(make_project, nona, caplog):
    plan = read_plan(make_project())
    remap(plan, "pano")
    (plan.folder / "pano0001.tif").unlink()
    with open_layers(plan, prefix="pano") as layers:
        assert names_of(layers) == ["pano0000.tif", "pano0002.tif"]
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "no layer of image 1 (photo 1.tif) under pano: it is left out" in caplog.text


def test_prefix_without_layers(make_project):
    with (
        pytest.raises(LayersMissingError, match=r"no layer nope0000\.tif .*check --prefix"),
        open_layers(read_plan(make_project()), prefix="nope"),
    ):
        pass


@pytest.mark.parametrize(
    ("prefix", "hint"),
    [
        ("l0000.tif", "--prefix l$"),
        ("l0002", "--prefix l$"),
        ("l.tif", "--prefix l$"),
        ("sub/0001.tif", "--prefix sub/$"),
        ("m0000.tif", r"m0000\.tif is a file: name all layers with --layers"),
        ("m.tif", "check --prefix"),
        ("0000.tif", "check --prefix"),
    ],
)
@pytest.mark.parametrize("here", [True, False])
def test_name_of_a_layer_as_prefix(make_project, monkeypatch, tmp_path, prefix, hint, here):
    """The message names the prefix that would do; m0000.tif is no file that could be a layer's."""
    plan = read_plan(make_project(disabled=(0,)))
    (plan.folder / "sub").mkdir()
    for name in ("l0000.tif", "l0001.tif", "l0002.tif", "sub/0001.tif", "m0000.tif"):
        (plan.folder / name).write_bytes(b"not opened")
    monkeypatch.chdir(plan.folder if here else tmp_path)
    with pytest.raises(LayersMissingError, match=hint), open_layers(plan, prefix=prefix):
        pass


def test_named_files_are_taken_in_the_order_given(make_project, nona):
    plan = read_plan(make_project())
    remap(plan, "x")
    files = [plan.folder / f"x{index:04d}.tif" for index in (2, 0)]
    with open_layers(plan, layers=files) as layers:
        assert names_of(layers) == ["x0002.tif", "x0000.tif"]
    with (
        pytest.raises(LayersMissingError, match=r"none\.tif: no such layer; check --layers"),
        open_layers(plan, layers=[files[0], plan.folder / "none.tif"]),
    ):
        pass


@pytest.mark.parametrize("request_", [{"remap": "sometimes"}, {"remap": "always", "prefix": "x"}])
def test_requests_that_make_no_sense(make_project, request_):
    with pytest.raises(SettingsError), open_layers(read_plan(make_project()), **request_):
        pass


# ------------------------------------------------------------------------------------ kept layers


def test_kept_layers_are_found_the_next_time(make_project, nona, monkeypatch):
    plan = read_plan(make_project(disabled=(1,)))
    with open_layers(plan, keep_layers=True) as layers:
        first = pixels_of(layers)
    assert sorted(path.name for path in plan.folder.glob("pano*.tif")) == ["pano0000.tif", "pano0002.tif"]
    assert not list(plan.folder.glob(".*"))
    monkeypatch.setattr(program, "_run", refuse)
    with open_layers(plan) as layers:
        assert same(pixels_of(layers), first)


# ------------------------------------------------------------------------------------ the real thing


def test_the_gopro_ring_has_layers_but_no_photos(caplog):
    """Layers named by the project's stem, photos gone; times are those of the checkout."""
    project = Path(__file__).parents[2] / "shared" / "photos" / "gopro_ring" / "layer_.pto"
    if not project.is_file():
        pytest.skip("the photographs are not here")  # they are too large for the repository, and not ours
    with open_layers(read_plan(project)) as layers:
        assert names_of(layers) == [f"layer_{index:04d}.tif" for index in range(6)]
        assert all((item.dtype, item.channels) == (np.uint8, 3) for item in layers)
        assert all(item.read(100, 101).shape == (1, item.box.width, 4) for item in layers)


def test_conftest_fails_in_ci_and_skips_elsewhere(monkeypatch):
    from conftest import require_program

    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="nona is not installed"):
        require_program("nona")
    monkeypatch.delenv("CI")
    with pytest.raises(pytest.skip.Exception, match="nona is not installed"):
        require_program("nona")
