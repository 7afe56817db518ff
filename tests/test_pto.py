"""Reading projects: every line type, links, dialects; editing; the files of the wild."""

from __future__ import annotations

from pathlib import Path

import pytest

from hugin_abflow import pto
from hugin_abflow.errors import OutputError, ProjectError, PtoError

CORPUS = Path(__file__).parent / "pto_corpus"
HUGIN = (CORPUS / "hugin.pto").read_bytes()
SHARED = Path(__file__).parents[2] / "shared"
# In the shared corpus, but no text of this grammar: a description, and templates with "{{width}}".
NO_PROJECTS = {
    "README.md": 0,
    "lianhaidong__libpano13__mpremap_script.txt": 54,
    "sinky__panorama.ps1__pano_tpl.pto": 7,
    "sinky__panorama.ps1__pano_tpl__v2.pto": 7,
    "sinky__panorama.ps1__pano_tpl__v3.pto": 7,
}


@pytest.fixture
def project() -> pto.Project:
    return pto.loads(HUGIN, "hugin.pto")


@pytest.fixture
def ptgui() -> pto.Project:
    return pto.load(CORPUS / "ptgui.pts")


def changed_lines(project: pto.Project, before: bytes = HUGIN) -> list[tuple[int, bytes]]:
    """Number and new bytes of all lines that an edit changed; the number of lines stays."""
    old, new = before.splitlines(), pto.dumps(project).splitlines()
    assert len(old) == len(new)
    return [(number, b) for number, (a, b) in enumerate(zip(old, new, strict=True), 1) if a != b]


def test_panorama_and_modes(project: pto.Project) -> None:
    panorama = project.panorama
    assert (panorama.projection, panorama.width, panorama.height, panorama.hfov) == (2, 4001, 2000, 360.0)
    assert (panorama.exposure, panorama.hdr, panorama.pixel_type) == (11.25, False, "UINT16")
    assert panorama.crop == (10, 101, 3990, 1899)
    assert panorama.output_format == "TIFF_m c:LZW r:CROP"
    assert (panorama.get("P"), panorama.get("k"), panorama.get("zz")) == ("60 0", "0", None)
    assert (project.modes.interpolator, project.modes.gamma, project.modes.get("m")) == (3, 1.0, "2")


def test_defaults_of_an_empty_panorama() -> None:
    panorama = pto.loads(b"p").panorama
    assert (panorama.projection, panorama.width, panorama.height, panorama.hfov) == (2, 3000, 1500, 360.0)
    assert (panorama.exposure, panorama.hdr, panorama.pixel_type, panorama.crop) == (0.0, False, "", None)
    assert panorama.output_format == "TIFF_m c:LZW r:CROP"
    assert pto.loads(b"p w801").panorama.height == 400


def test_images(project: pto.Project) -> None:
    first, second, third = project.images
    assert [image.index for image in project.images] == [0, 1, 2]
    names = ["one's room.jpg", "C:\\photos\\zwei.jpg", "/data/drei müde.jpg"]
    assert [image.filename for image in project.images] == names
    assert (first.width, first.height, first.projection) == (3001, 2003, 0)
    assert (third.width, third.height, third.projection) == (2001, 2001, 2)
    assert [image.disabled for image in project.images] == [False, True, False]
    assert (first.crop, third.crop) == (None, (-12, 5, 2013, 1995))
    assert (third.get("Vf"), third.get("Vm"), third.get("S")) == ("flat.tif", "6", "-12,2013,5,1995")
    assert first.variable("Eev") == 11.5
    assert second.variable("Eev") == 9.5


def test_links_are_followed_through_chains(project: pto.Project) -> None:
    first, second, third = project.images
    assert (first.link("v"), second.link("v"), third.link("v"), third.link("y")) == (None, 0, 1, None)
    assert (second.variable("v"), third.variable("v"), third.variable("b")) == (54.25, 54.25, -0.0123)
    assert third.get("v") == "=1"
    first.set("v", 61.5)
    assert third.variable("v") == 61.5


def test_absent_variables_have_the_defaults_of_hugin(project: pto.Project) -> None:
    third = project.images[2]
    assert (third.variable("Va"), third.variable("d"), third.variable("TrX")) == (1.0, 0.0, 0.0)


def test_stacks_are_linked_images(project: pto.Project) -> None:
    assert [image.stack for image in project.images] == [0, 0, 1]
    assert [[image.index for image in stack] for stack in project.stacks] == [[0, 1], [2]]
    unlinked = pto.loads(b"p\ni j0\ni j0\n")
    assert [image.stack for image in unlinked.images] == [0, 0]
    assert len(unlinked.stacks) == 2, "the same number without a link is no stack"


def test_forward_links() -> None:
    images = pto.loads(b"p\ni v=2\ni v=0\ni v33\n").images
    assert [image.variable("v") for image in images] == [33.0] * 3


def test_control_points(project: pto.Project) -> None:
    first, second = project.control_points
    assert (first.image1, first.image2, first.type) == (0, 1, 0)
    assert (first.x1, first.y1, first.x2, first.y2) == (10.5, 20.25, 30.0, -4e-05)
    assert (second.image1, second.image2, second.type) == (1, 2, 4)
    assert (second.x1, second.y1, second.x2, second.y2) == (1.0, 2.0, 3.0, 4.0)
    assert project.control_points[-1] is second
    assert project.control_points[:1] == [first]


def test_masks(project: pto.Project) -> None:
    (mask,) = project.images[2].masks
    assert project.images[0].masks == []
    assert (mask.image, mask.type) == (2, 1)
    assert mask.points == [(10.0, 10.0), (20.5, 10.0), (20.5, 30.0)]


def test_variables(project: pto.Project) -> None:
    assert [line.entries for line in project.variables] == [[("Ra", 0)], [("y", 1), ("r", 1), ("p", 1)], []]


def test_options(project: pto.Project) -> None:
    assert project.options["outputImageType"] == "jpg", "of an option given twice the last one counts"
    assert "enblendOptions" not in project.options, "an empty value keeps the default"
    assert project.option("enblendOptions", "-l 29") == "-l 29"
    assert project.option("outputJPEGQuality", "90") == "92"
    assert project.option("nothing", "x") == "x"


def test_hugin_lines_count_only_if_there_is_one_for_each_image() -> None:
    data = b"p\n#-hugin  cropFactor=1 disabled\ni w5\ni w6\n"
    assert [image.disabled for image in pto.loads(data).images] == [False, False]
    data = b"p\n#-hugin disabled\ni w5\n#-hugin disabledX\ni w6\n"
    assert [image.disabled for image in pto.loads(data).images] == [True, False]


def test_comments_unknown_lines_and_keys_are_kept(project: pto.Project) -> None:
    assert "# control points" in project.comments
    data = b'p w5 Qx17 +odd {z}\nnonsense line\ni h4 ve5 Zq"a b"\n'
    unknown = pto.loads(data)
    assert unknown.comments == ["nonsense line"]
    assert (unknown.panorama.get("Qx"), unknown.images[0].get("ve")) == ("17", "5")
    assert (unknown.images[0].get("Zq"), unknown.images[0].get("v")) == ("a b", None)
    assert pto.dumps(unknown) == data


def test_ptgui(ptgui: pto.Project) -> None:
    first, second = ptgui.images
    assert (first.filename, first.width, first.height) == ("left \\ one.png", 257, 129)
    assert (second.filename, second.width, second.height) == ("right.png", 255, 127)
    assert first.variable("v") == 125.5, "0 is the dummy image"
    assert second.variable("v") == 125.5, "1 is the first real image, which links to the dummy image"
    assert (first.variable("a"), second.variable("a")) == (-0.25, 0.125)
    assert (first.crop, second.crop) == ((-21, -4, 941, 521), None), "an empty crop is none"
    (point,) = ptgui.control_points
    assert (point.image1, point.image2) == (0, 1), "control points count the dummy image"
    assert ptgui.variables[0].entries == [("v", None), ("b", None), ("y", 2), ("r", 2)]


def test_old_ptgui_does_not_count_the_dummy_image() -> None:
    data = (CORPUS / "ptgui.pts").read_bytes()
    old = data.replace(b"#-fileversion 49", b"#-fileversion 7").replace(b"c n1 N2", b"c n0 N1")
    old = old.replace(b"v v b y2 r2", b"v y1")
    (point,) = pto.loads(old).control_points
    assert (point.image1, point.image2) == (0, 1)


def test_image_files_count_only_if_there_is_one_for_each_image() -> None:
    data = b'p\n#-imgfile 10 20 "a.jpg"\no v1\no v2 n"b.jpg"\n'
    assert [(image.filename, image.width) for image in pto.loads(data).images] == [("", 0), ("b.jpg", 0)]


def test_i_and_o_lines_of_the_same_index_are_one_image() -> None:
    project = pto.load(CORPUS / "panotools.txt")
    first, second = project.images
    assert [image.filename for image in project.images] == ["a.jpg", "b.jpg"]
    assert (first.variable("y"), first.variable("r")) == (1.0, 7.0), "the i-line first, then the o-line"
    assert first.link("v") == 1, "except where only the o-line links"
    assert (first.variable("v"), second.variable("v")) == (91.0, 91.0), (
        "of a key given twice the first counts"
    )
    assert project.panorama.output_format == "PSD_mask"
    first.set("r", 9.5)
    first.set("y", 2)
    lines = pto.dumps(project).splitlines()
    assert lines[1] == b'i n"a.jpg" w640 h480 f3 y2 v90'
    assert lines[3] == b"o f3 y5 r9.5 v=1 -buf o"


@pytest.mark.parametrize("number_of_i_lines", [0, 1, 3])
def test_more_lines_of_one_kind_than_of_the_other(number_of_i_lines: int) -> None:
    project = pto.loads(b"p\n" + b"i w7\n" * number_of_i_lines + b"o h5\no h6\n")
    sizes = [(image.width, image.height) for image in project.images]
    assert sizes == {0: [(0, 5), (0, 6)], 1: [(7, 5), (0, 6)], 3: [(7, 5), (7, 6), (7, 0)]}[number_of_i_lines]


def test_lines_after_the_asterisk_are_read_as_nona_does() -> None:
    data = b'p w5\n*\ni w7\nk i0 t0 p"1 2 3 4 5 6"\n#hugin_outputImageType jpg\n* and\ni w8\n'
    project = pto.loads(data)
    assert [image.width for image in project.images] == [7, 8]
    assert len(project.images[0].masks) == 1
    assert project.option("outputImageType", "") == "jpg"
    project.options["blender"] = "enblend"
    added = data.replace(b"p w5\n", b"p w5\n#hugin_blender enblend\n")
    assert pto.dumps(project) == added, "where panotools read it, too"


VARIANTS = {
    "crlf": HUGIN.replace(b"\n", b"\r\n"),
    "cr": HUGIN.replace(b"\n", b"\r"),
    "bom": b"\xef\xbb\xbf" + HUGIN,
    "tabs": HUGIN.replace(b" ", b"\t  "),
    "no newline at the end": HUGIN.rstrip(),
    "blanks at the ends": HUGIN.replace(b"\n", b" \t \n"),
    "latin-1": HUGIN.decode().encode("latin-1"),
}


@pytest.mark.parametrize("data", VARIANTS.values(), ids=VARIANTS)
def test_variants_are_read_alike_and_written_byte_for_byte(data: bytes) -> None:
    project = pto.loads(data)
    assert pto.dumps(project) == data
    assert (project.panorama.width, len(project.images), len(project.control_points)) == (4001, 3, 2)
    assert [image.variable("v") for image in project.images] == [54.25] * 3
    assert project.images[1].disabled
    assert project.option("outputImageType", "") == "jpg"
    for point in project.control_points:
        point.x1 = point.x1
    assert pto.dumps(project) == data, "the same value is written as it was"


def test_names_that_are_no_utf8_survive() -> None:
    project = pto.loads(b'p\ni n"m\xfcde.jpg"\n')
    assert project.images[0].filename == "m\udcfcde.jpg"
    project.images[0].filename = "x" + project.images[0].filename
    assert pto.dumps(project) == b'p\ni n"xm\xfcde.jpg"\n'


def test_edits_change_one_line_each(project: pto.Project) -> None:
    project.panorama.crop = (1, 2, 3, 4)
    expected = HUGIN.splitlines()[2].replace(b"S10,3990,101,1899", b"S1,3,2,4")
    assert changed_lines(project) == [(3, expected)]
    project.panorama.crop = (10, 101, 3990, 1899)
    assert changed_lines(project) == []
    project.images[0].disabled = True
    project.images[1].disabled = False
    assert changed_lines(project) == [
        (7, b"#-hugin  cropFactor=1.5 disabled"),
        (9, b"#-hugin  cropFactor=1.5"),
    ]
    project.images[0].disabled = False
    project.images[1].disabled = True
    project.variables[1].entries = [("y", 1), ("TrX", 2)]
    project.options["blender"] = "internal"
    project.control_points[1].y1 = 2.5
    project.masks[0].points = [(0, 0.5), (1, 2)]
    assert [line for _, line in changed_lines(project)] == [
        b"v y1 TrX2",
        b"c n1 N2  t4 X3 Y4 x1 y2.5",
        b'k i2 t1 p"0 0.5 1 2"',
        b"#hugin_blender internal",
    ]


def test_fields_are_added_and_removed(project: pto.Project) -> None:
    panorama = project.panorama
    for key in "fwhvkERTSPn":
        panorama.set(key, None)
    assert pto.dumps(project).splitlines()[2] == b"p"
    panorama.set("w", 77)
    panorama.pixel_type = "FLOAT"
    panorama.set("Q", 1.5)
    assert pto.dumps(project).splitlines()[2] == b'p w77 T"FLOAT" Q1.5'


def test_removing_a_field_does_not_join_its_neighbours() -> None:
    project = pto.loads(b'p h4 n"a"w3\n')
    project.panorama.set("n", None)
    assert pto.dumps(project) == b"p h4 w3\n"
    assert (project.panorama.height, project.panorama.width) == (4, 3)


def test_lines_that_the_file_lacks_are_added_when_they_are_set() -> None:
    data = b"\xef\xbb\xbfi w5\r\ni w6"
    project = pto.loads(data)
    assert pto.dumps(project) == data
    project.panorama.width = 99
    project.options["outputImageType"] = "png"
    assert pto.dumps(project) == data + b"\r\np w99\r\n#hugin_outputImageType png\r\n"
    again = pto.loads(pto.dumps(project))
    assert (again.panorama.width, again.options["outputImageType"]) == (99, "png")


def test_options_are_emptied_and_filled(project: pto.Project) -> None:
    del project.options["outputImageType"]
    project.options["enblendOptions"] = "-l 29"
    assert [line for _, line in changed_lines(project)] == [
        b"#hugin_enblendOptions -l 29",
        b"#hugin_outputImageType ",
        b"#hugin_outputImageType ",
    ]
    assert "outputImageType" not in pto.loads(pto.dumps(project)).options
    with pytest.raises(KeyError):
        del project.options["outputImageType"]


def test_dump_replaces_a_file_only_by_a_whole_one(project: pto.Project, tmp_path: Path) -> None:
    path = tmp_path / "out.pto"
    path.write_bytes(b"old")
    path.chmod(0o640)
    pto.dump(project, path)
    assert path.read_bytes() == HUGIN
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OutputError, match="nowhere"):
        pto.dump(project, tmp_path / "nowhere" / "x.pto")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError):
        pto.dump(project, tmp_path / "folder")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["folder", "out.pto"]


@pytest.mark.parametrize("name", ["missing.pto", "", "nul\0.pto"])
def test_a_file_that_cannot_be_read(name: str, tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match="cannot be read"):
        pto.load(f"{tmp_path}/{name}")


def shared_projects() -> list[Path]:
    return sorted([*SHARED.glob("pto_corpus/*"), *SHARED.glob("photos/*/*.pto")])


@pytest.mark.skipif(not shared_projects(), reason="no project files under ../shared")
def test_projects_of_the_wild_round_trip() -> None:
    refused: dict[str, int] = {}
    for path in shared_projects():
        data = path.read_bytes()
        try:
            project = pto.loads(data, path.name)
        except PtoError as error:
            refused[path.name] = error.line
            continue
        assert pto.dumps(project) == data, path.name
        for image in project.images:
            assert image.variable("v") > 0, path.name
        for point in project.control_points:
            assert point.image1 < len(project.images), path.name
        assert pto.dumps(project) == data, path.name
    assert refused == NO_PROJECTS
