"""From a project file to a plan."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile
from conftest import require_program

from hugin_abflow.errors import ProjectError, PtoError
from hugin_abflow.layer import Box
from hugin_abflow.project import WRAPPING, locate_photo, read_plan


def test_a_plain_project(make_project):
    plan = read_plan(make_project())
    assert (plan.canvas.width, plan.canvas.height) == (802, 401)
    assert plan.canvas.crop == Box(0, 0, 802, 401)
    assert plan.canvas.wraps and plan.canvas.spherical and plan.canvas.hfov == 360
    assert [image.index for image in plan.images] == [0, 1, 2]
    assert all(image.photo.is_file() for image in plan.images)
    assert plan.hugin_prefix == "photo 0 - photo 2"
    assert not plan.hdr
    assert plan.file.is_absolute() and plan.folder == plan.file.parent and plan.stem == "pano"


@pytest.mark.parametrize(
    ("number", "name"),
    [(0, "rectilinear"), (2, "equirectangular"), (21, "Hammer-Aitoff"), (99, "projection 99")],
)
def test_projection_in_words(make_project, number, name):
    assert read_plan(make_project(panorama=f"f{number} w802 h401 v100")).projection == name


def test_disabled_images_leave_gaps(make_project):
    plan = read_plan(make_project(disabled=(0, 2), yaws=(0, 40, 80, 120)))
    assert [image.index for image in plan.images] == [1, 3]
    assert [image.name for image in plan.images] == ["photo 1.tif", "photo 3.tif"]
    assert plan.hugin_prefix == "photo 0 - photo 3"  # Hugin counts disabled images here


def test_no_active_image(make_project):
    with pytest.raises(ProjectError, match=r"pano\.pto has no active image; enable"):
        read_plan(make_project(disabled=(0, 1, 2)))


@pytest.mark.parametrize(
    "crop, expected",
    [
        ("", Box(0, 0, 802, 401)),
        (" S100,700,20,390", Box(100, 20, 700, 390)),
        (" S-20,900,-5,9999", Box(0, 0, 802, 401)),
        (" S100,801,0,401", Box(100, 0, 801, 401)),
    ],
)
def test_crop_is_clipped_to_the_canvas(make_project, crop, expected):
    assert read_plan(make_project(panorama=f"f2 w802 h401 v360{crop}")).canvas.crop == expected


@pytest.mark.parametrize("crop", ["100,100,0,50", "300,200,0,50", "900,950,0,50", "0,50,-20,0"])
def test_empty_crop(make_project, crop):
    with pytest.raises(ProjectError, match=r"pano\.pto: the crop .* holds nothing of the 802x401 canvas"):
        read_plan(make_project(panorama=f"f2 w802 h401 v360 S{crop}"))


@pytest.mark.parametrize("projection", range(22))
def test_wrap_needs_a_wrapping_projection_and_360_degrees(make_project, projection):
    wraps = projection in (1, 2, 5, 8, 11, 13)
    for hfov, full in ((360, True), (361, True), (359, False), (100, False)):
        canvas = read_plan(make_project(panorama=f"f{projection} w800 h400 v{hfov}")).canvas
        assert canvas.wraps == (wraps and full)
        assert canvas.spherical == (projection == 2)


def test_wrapping_projections_are_those_of_libpano(tmp_path, nona):
    """A smooth sphere, remapped: where the canvas wraps, its last column goes on in its first."""
    width, height = 360, 180
    lat, lon = np.mgrid[0:height, 0:width] * (np.pi / 180) + np.pi / 360
    directions = [np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat)]
    sphere = np.stack(directions, -1) * 32000 + 32768
    tifffile.imwrite(tmp_path / "sphere.tif", sphere.astype(np.uint16), photometric="rgb")
    found = set()
    for projection in range(22):
        (tmp_path / "a.pto").write_text(
            f'p f{projection} w361 h181 v360 n"TIFF_m c:NONE"\nm i0\n'
            f"i w{width} h{height} f4 v360 Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r0 p0 y0 "
            'TrX0 TrY0 TrZ0 j0 a0 b0 c0 d0 e0 g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n"sphere.tif"\n'
        )
        subprocess.run(
            [nona, "-m", "TIFF_m", "-o", "a", "a.pto"], cwd=tmp_path, check=True, capture_output=True
        )
        pixels = tifffile.imread(tmp_path / "a0000.tif").astype(float)
        (tmp_path / "a0000.tif").unlink()
        both = (pixels[:, 0, 3] > 0) & (pixels[:, -1, 3] > 0)
        step = np.abs(pixels[:, 0, :3] - pixels[:, -1, :3]).max(axis=1)
        inside = np.abs(pixels[:, 0, :3] - pixels[:, 1, :3]).max(axis=1)
        straight = both.sum() > 0.5 * len(both)  # curved borders meet in few rows only
        if straight and (step[both] <= 1.5 * inside[both] + 200).all():
            found.add(projection)
    assert found == WRAPPING


@pytest.mark.parametrize("projection, width", [(2, 802), (7, 802), (0, 801), (1, 801), (4, 801)])
def test_odd_widths_are_rounded_as_hugin_does(make_project, nona, projection, width, tmp_path):
    project = make_project(panorama=f'f{projection} w801 h401 v100 n"TIFF_m c:LZW r:CROP"', yaws=(0,))
    assert read_plan(project).canvas.width == width
    subprocess.run([nona, "-m", "TIFF_m", "-o", tmp_path / "a", project], check=True, capture_output=True)
    tags = tifffile.TiffFile(tmp_path / "a0000.tif").pages[0].tags
    assert (tags[33300].value, tags[33301].value) == (width, 401)


@pytest.mark.parametrize(
    "panorama, extra",
    [
        ("f2 w801 h401 v360", ""),
        ("f2 w801 h401 v360 S3,700,10,390", ""),
        ("f2 w802 h401 v360 S-20,900,-5,9999", ""),
        ("f1 w802 h401 v360", ""),
        ("f2 w802 h401 v359", ""),
        ("f0 w801 h401 v90", "#hugin_outputImageType png\n"),
        ("f2 w802 h401 v360", "#hugin_outputImageType jpg\n#hugin_outputJPEGQuality 83\n"),
        ("f2 w802 h401 v360", "#hugin_outputImageType jpg\n"),
        ("f2 w802 h401 v360", "#hugin_outputImageTypeCompression PACKBITS\n"),
        ("f2 w802 h401 v360 R1", ""),
        ("f2 w802 h401 v360 R1", "#hugin_outputLDRBlended false\n#hugin_outputHDRBlended true\n"),
        (
            "f2 w802 h401 v360",
            "#hugin_outputLDRBlended false\n#hugin_outputHDRBlended true\n#hugin_outputImageTypeHDR tif\n",
        ),
        ("f2 w802 h401 v360", "#hugin_outputLDRBlended true\n#hugin_outputHDRBlended true\n"),
    ],
)
def test_plan_agrees_with_hugins_own_commands(make_project, panorama, extra):
    """What `hugin_executor -d` would run: size, offset, wrap, file type, compression, kind of layers."""
    executor = require_program("hugin_executor")
    explicit = "" if "Blended" in extra else "#hugin_outputLDRBlended true\n#hugin_outputHDRBlended false\n"
    project = make_project(panorama=panorama, extra=explicit + extra)
    shown = subprocess.run([executor, "-s", "-d", project], capture_output=True, text=True, check=True).stdout
    command = next(line for line in shown.splitlines() if line.startswith("enblend"))
    plan = read_plan(project)
    width, height, left, top = re.search(r"-f(\d+)x(\d+)(?:\+(\d+)\+(\d+))?", command).groups(default="0")
    crop = plan.canvas.crop
    assert (crop.width, crop.height, crop.left, crop.top) == tuple(map(int, (width, height, left, top)))
    # a crop narrower than the canvas has no border to wrap, nothing else is different
    assert (plan.canvas.wraps and crop.width == plan.canvas.width) == (" -w" in command)
    output = re.search(r"-o (.*?) --", command).group(1).replace("\\", "")
    assert Path(output).suffix == plan.output.ending
    assert Path(output).stem.removesuffix("_hdr") == plan.hugin_prefix
    compression = re.search(r"--compression=(\w+)", command)
    if plan.output.ending == ".jpg":
        assert int(compression.group(1)) == plan.output.jpeg_quality
    elif plan.output.ending == ".tif" and compression:
        assert compression.group(1).lower() == (plan.output.compression or "lzw")
    assert plan.hdr == ("EXR_m" in shown.splitlines()[0])


@pytest.mark.parametrize(
    "n, ending, compression, quality",
    [
        ("TIFF_m c:LZW r:CROP", ".tif", "lzw", 100),
        ("TIFF c:NONE", ".tif", "none", 100),
        ("TIFF_m c:DEFLATE", ".tif", "deflate", 100),
        ("tiff", ".tif", None, 100),
        ("JPEG g0 q95", ".jpg", None, 95),
        ("JPEG_m", ".jpg", None, 100),
        ("JPEG q900", ".jpg", None, 100),
        ("PNG", ".png", None, 100),
        ("EXR", ".exr", None, 100),
        ("PSD_mask", ".tif", None, 100),
        ("TIFF c:WHAT", ".tif", None, 100),
    ],
)
def test_older_scripts_name_the_output_in_the_p_line(make_project, n, ending, compression, quality):
    output = read_plan(make_project(panorama=f'f2 w802 h401 v360 n"{n}"')).output
    assert (output.ending, output.compression, output.jpeg_quality) == (ending, compression, quality)


def test_hugin_lines_win_and_nonsense_keeps_the_default(make_project):
    extra = "#hugin_outputImageType jpg\n#hugin_outputJPEGQuality none\n#hugin_outputImageTypeCompression\n"
    output = read_plan(make_project(panorama='f2 w802 h401 v360 n"PNG"', extra=extra)).output
    assert (output.ending, output.compression, output.jpeg_quality) == (".jpg", None, 100)
    for quality, taken in (("9" * 5000, 100), ("0" * 5000 + "87", 87), ("0", 1)):
        extra = f"#hugin_outputImageType jpg\n#hugin_outputJPEGQuality {quality}\n"
        assert read_plan(make_project(extra=extra)).output.jpeg_quality == taken


@pytest.mark.parametrize(("kind", "compression"), [("tif", "lzw"), ("exr", None)])
def test_compression_is_that_of_a_tiff(make_project, kind, compression):
    """Hugin writes LZW beside EXR as well, where it means nothing."""
    extra = (
        "#hugin_outputLDRBlended false\n#hugin_outputHDRBlended true\n"
        f"#hugin_outputImageTypeHDR {kind}\n#hugin_outputImageTypeHDRCompression LZW\n"
    )
    output = read_plan(make_project(panorama="f2 w802 h401 v360", extra=extra)).output
    assert (output.ending, output.compression) == (f".{kind}", compression)


def test_scripts_without_hugin_lines_say_hdr_in_the_p_line(make_project):
    plan = read_plan(make_project(panorama="f2 w802 h401 v360 R1"))
    assert plan.hdr and plan.output.ending == ".exr"


# ------------------------------------------------------------------------------------ names


def test_default_output_is_beside_the_project_and_never_an_input(make_project, tmp_path):
    plan = read_plan(make_project(folder="päno mit Raum", stem="mein päno"))
    first = plan.folder / "mein päno.tif"
    assert plan.default_output() == first
    assert plan.default_output([first]) == plan.folder / "mein päno_abflow.tif"
    second = plan.folder / "Mein Päno_ABFLOW.tif"  # the same file where names ignore case
    assert plan.default_output([first, second]) == plan.folder / "mein päno_abflow2.tif"


@pytest.mark.parametrize("disabled", [(), (1,)])
def test_default_output_is_no_photo(make_project, disabled):
    plan = read_plan(make_project(stem="photo 1", disabled=disabled))
    assert [photo.name for photo in plan.photos] == ["photo 0.tif", "photo 1.tif", "photo 2.tif"]
    assert plan.default_output() == plan.folder / "photo 1_abflow.tif"


@pytest.mark.parametrize("ending, stem", [("", "huginpto_X.1"), (".PTO", "Pano"), (".pto.bak", "x")])
def test_projects_of_other_endings(make_project, ending, stem):
    plan = read_plan(make_project(stem=stem, ending=ending))
    assert plan.stem == (stem + ending).removesuffix(".PTO")
    assert plan.default_output().name == f"{plan.stem}.tif"


def test_photos_are_found_where_hugin_looks(tmp_path):
    (tmp_path / "sub").mkdir()
    for name in ("a.jpg", "sub/b.jpg", "c d.jpg"):
        (tmp_path / name).touch()
    elsewhere = tmp_path / "sub" / "b.jpg"
    assert locate_photo(tmp_path, "a.jpg") == tmp_path / "a.jpg"
    assert locate_photo(tmp_path, "sub/b.jpg") == elsewhere
    assert locate_photo(tmp_path / "x", str(elsewhere)) == elsewhere
    assert locate_photo(tmp_path, "sub\\b.jpg") == elsewhere  # written on Windows
    assert locate_photo(tmp_path, "C:\\Users\\me\\c d.jpg") == tmp_path / "c d.jpg"  # moved
    assert locate_photo(tmp_path, "C:/Users/me/a.jpg") == tmp_path / "a.jpg"
    assert locate_photo(tmp_path, "\\\\server\\share\\a.jpg") == tmp_path / "a.jpg"
    assert locate_photo(tmp_path, "/home/me/a.jpg") == tmp_path / "a.jpg"
    assert locate_photo(tmp_path, "/home/me/none.jpg") == Path("/home/me/none.jpg")
    assert locate_photo(tmp_path, "none.jpg") == tmp_path / "none.jpg"
    assert locate_photo(tmp_path, r"..\none.jpg").name == r"..\none.jpg"
    if os.name != "nt":  # to be put there
        assert locate_photo(tmp_path, r"C:\Users\me\none.jpg") == tmp_path / "none.jpg"


def test_photos_whose_names_another_system_takes_for_the_same(tmp_path):
    """Upper and lower case, and umlauts in one part or two; never one of several."""
    folder = tmp_path / "Fotos"
    folder.mkdir()
    for name in ("img_1.jpg", "Stra\u0308nd.jpg", "two.jpg", "Two.jpg"):
        (folder / name).touch()
    if (folder / "IMG_1.JPG").exists():
        pytest.skip("this system takes them for the same")
    assert locate_photo(folder, "IMG_1.JPG") == folder / "img_1.jpg"
    assert locate_photo(tmp_path, "fotos\\IMG_1.JPG") == folder / "img_1.jpg"
    assert locate_photo(folder, r"C:\shoot\Img_1.jpg") == folder / "img_1.jpg"  # moved
    assert locate_photo(folder, str(tmp_path / "FOTOS" / "img_1.JPG")) == folder / "img_1.jpg"
    assert locate_photo(folder, "str\u00e4nd.jpg") == folder / "Stra\u0308nd.jpg"
    assert locate_photo(folder, "two.jpg") == folder / "two.jpg"
    assert locate_photo(folder, "TWO.jpg") == folder / "TWO.jpg"  # which of them?
    assert locate_photo(folder, "IMG_1.JPG/x.jpg") == folder / "IMG_1.JPG/x.jpg"
    assert locate_photo(folder, "a\0.jpg") == folder / "a\0.jpg"


def test_photos_lie_beside_the_project_that_a_link_leads_to(make_project, tmp_path):
    project = make_project(stem="pano")
    (tmp_path / "links").mkdir()
    link = tmp_path / "links" / "linked.pto"
    try:
        link.symlink_to(project)
    except OSError:
        pytest.skip("this system does not let us make links")
    assert read_plan(link).photos == read_plan(project).photos
    unnamed = link.with_suffix("")  # as /dev/stdin is
    unnamed.symlink_to(project)
    assert read_plan(unnamed).photos[0] == link.with_name("photo 0.tif")
    nearer = link.with_name("photo 1.tif")
    nearer.touch()
    assert read_plan(link).photos[1] == nearer  # there Hugin finds it
    (project.parent / "photo 0.tif").unlink()
    assert read_plan(link).photos[0] == link.with_name("photo 0.tif")


def test_a_backslash_may_be_part_of_a_name(tmp_path):
    try:
        (tmp_path / "a\\b.jpg").touch()
    except OSError:
        pytest.skip("this system has no such names")  # on Windows a backslash parts folders
    assert locate_photo(tmp_path, "a\\b.jpg") == tmp_path / "a\\b.jpg"


def test_what_is_no_project(tmp_path):
    (tmp_path / "a.pto").write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
    with pytest.raises(PtoError):
        read_plan(tmp_path / "a.pto")
    with pytest.raises(ProjectError, match=r"none\.pto"):
        read_plan(tmp_path / "none.pto")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_told_without_waiting_for_it(tmp_path):
    """A shell's <(...) is one; its second reader found nothing."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ProjectError, match=r"pipe is a pipe, which can be read but once.*; save it as"):
        read_plan(tmp_path / "pipe")


def test_all_real_projects_have_a_plan():
    corpus = Path(__file__).parents[2] / "shared" / "pto_corpus"
    if not corpus.is_dir():
        pytest.skip("the corpus of real projects is not here")  # others wrote them: not ours to publish
    for file in sorted(corpus.glob("*.pto")):
        try:
            plan = read_plan(file)
        except ProjectError as error:
            assert str(file) in str(error)
            continue
        crop = plan.canvas.crop
        assert 0 <= crop.left < crop.right <= plan.canvas.width
        assert 0 <= crop.top < crop.bottom <= plan.canvas.height
        assert plan.default_output().parent == file.parent
