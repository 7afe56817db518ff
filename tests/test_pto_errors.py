"""Malformed projects: each raises `PtoError` with its line, the token and what was expected."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import pytest

from hugin_abflow import pto
from hugin_abflow.errors import ExitCode, PtoError
from hugin_abflow.pto import grammar

HUGIN = (Path(__file__).parent / "pto_corpus" / "hugin.pto").read_bytes()

# What line, put in as line 5 of a project with two images; the token that is named; what is expected.
MALFORMED = [
    (b"i w", "w", "a whole number from 0"),
    (b"i wide", "wide", "a whole number from 0"),
    (b"i w5x7", "w5x7", "a whole number from 0"),
    (b"i h-5", "h-5", "a whole number from 0"),
    (b"i w1000000000000", "w1000000000000", "a whole number from 0"),
    (b"i f=0", "f=0", "a whole number from 0"),
    (b"i v1e999", "v1e999", "a number or '='"),
    (b"i ynan", "ynan", "a number or '='"),
    (b"i y1,5", "y1,5", "a number or '='"),
    (b"i v=", "v=", "a number or '='"),
    (b"i v=-1", "v=-1", "a number or '='"),
    (b"i v=0x", "v=0x", "a number or '='"),
    (b'i n"open', '"open', "a closing quote"),
    (b"i n", "n", "a text within quotes"),
    (b"i S1,2,3", "S1,2,3", "four whole numbers"),
    (b"i S1,2,3,4,5", "S1,2,3,4,5", "four whole numbers"),
    (b"i v=3", "v=3", "a link to one of the 3 images"),
    (b"i v=2", "v=2", "not in a circle"),
    (b"o v=999999999", "v=999999999", "a link to one of the 2 images"),
    (b"p w5", "p w5", "all of f, w, h, v, or none but S, beside the p-line in line 1; delete one of the two"),
    (b"v y2", "y2", "an image's number from 0 to 1"),
    (b'#-imgfile 5 "x"', '#-imgfile 5 "x"', 'width, height and "name"'),
    (b'#-imgfile 5 6 "x', '"x', "a closing quote"),
    (b'#-imgfile 5 -6 "x"', "-6", "a whole number from 0"),
    (b'i n"caf\xe9" w\xe9', "w\\xe9", "a whole number from 0"),
    (b"\0", "\0", "without NUL bytes"),
]

# The same of lines without which there is a panorama, as nona makes its layers.
LEFT_OUT = [
    (b"c n0 N1 x1 y2 X3 t0", "c n0 N1 x1 y2 X3 t0", "a field 'Y'"),
    (b"c n0 N1 x1 y2 X3 Yoops t0", "Yoops", "a number after 'Y'"),
    (b"c n0 N1 x1 y2 X3 Y4 t-1", "t-1", "a whole number from 0 after 't'"),
    (b"c n0 N2 x1 y2 X3 Y4 t0", "N2", "an image's number from 0 to 1"),
    (b"c N0 n2 x1 y2 X3 Y4", "n2", "an image's number from 0 to 1"),
    (b"c n0 N1 x1e999 y2 X3 Y4 t0", "x1e999", "a number after 'x'"),
    (b"c", "c", "a field 'n'"),
    (b'k i2 t0 p"1 2 3 4"', "i2", "an image's number from 0 to 1"),
    (b'k i0 t5 p"1 2 3 4"', "t5", "a mask type from 0 to 4"),
    (b'k i0 t0 p"1 2 3"', 'p"1 2 3"', "pairs of numbers"),
    (b'k i0 t0 p"1 2 3 x"', 'p"1 2 3 x"', "pairs of numbers"),
    (b"k i0 t0", "k i0 t0", "a field 'p'"),
    (b"v y0 what", "what", "a variable with an image's number"),
    (b'v y0 "', '"', "a closing quote"),
]


@pytest.mark.parametrize("line_end", [b"\n", b"\r\n"], ids=["lf", "crlf"])
@pytest.mark.parametrize(("line", "token", "expected"), MALFORMED)
def test_the_error_names_line_token_and_expectation(
    line: bytes, token: str, expected: str, line_end: bytes
) -> None:
    data = line_end.join([b"p w9", b"m i0", b"i w5", b"i w6", line, b"# the end", b""])
    with pytest.raises(PtoError) as caught:
        pto.loads(data, "folder/x.pto")
    error = caught.value
    assert (error.file, error.line, error.token) == ("folder/x.pto", 5, token)
    assert expected in error.expected
    assert str(error).startswith("folder/x.pto, line 5: found ")
    assert error.exit_code is ExitCode.PROJECT


@pytest.mark.parametrize(("line", "token", "expected"), LEFT_OUT)
def test_a_line_without_which_there_is_a_panorama_is_left_out(line: bytes, token: str, expected: str) -> None:
    good = [b'k i1 t0 p"1 2 3 4 5 6"', b"c n0 N1 x1 y2 X3 Y4 t0", b"v y1"]
    data = b"\n".join([b"p w9", b"m i0", b"i w5", b"i w6", line, *good, b""])
    project = pto.loads(data, "folder/x.pto")
    (doubt,) = project.doubts
    assert doubt.startswith(f"folder/x.pto, line 5: found {token!r}, expected {expected}")
    assert doubt.endswith("it is left out, though nona may obey it; correct or delete that line")
    kept = [*project.masks, *project.control_points, *project.variables]
    assert [one.raw.rstrip() for one in kept] == good, "and no other line is"
    assert pto.dumps(project) == data


def test_of_two_p_or_m_lines_the_later_counts_where_it_says_something() -> None:
    """As nona 2022.0 has it: with the whole geometry in the second line, or none of it."""
    data = b'p f0 w200 h100 v80 E3\nm i1 g2\np f2 w400 h200 v90 n"JPEG"\nm g1\np R1\ni w5\n'
    project = pto.loads(data, "x.pto")
    panorama = project.panorama
    assert (panorama.projection, panorama.width, panorama.height, panorama.hfov) == (2, 400, 200, 90)
    assert (panorama.exposure, panorama.output_format, panorama.hdr) == (3, "JPEG", True)
    assert (project.modes.interpolator, project.modes.gamma) == (1, 1)
    lines = [3, 4, 5]
    assert [doubt.partition(":")[0] for doubt in project.doubts] == [f"x.pto, line {at}" for at in lines]
    panorama.width = 500
    panorama.set("E", None)
    panorama.set("n", None)
    panorama.set("k", 1)
    panorama.hdr = False
    edited = b"p f0 w200 h100 v80\nm i1 g2\np f2 w500 h200 v90\nm g1\np R0 k1\ni w5\n"
    assert pto.dumps(project) == edited
    assert (panorama.width, panorama.exposure, panorama.get("k")) == (500, 0, "1")


def test_a_second_p_line_without_a_crop_is_refused_beside_one_with_a_crop() -> None:
    """Hugin scales the crop as the width changes."""
    with pytest.raises(PtoError, match=r"all of f, w, h, v, S, or none but S, .* line 1; delete one"):
        pto.loads(b"p f0 w200 h100 v80 S0,100,0,50\np f0 w300 h150 v80\ni w5\n")


def test_a_second_p_line_with_a_crop_alone_scales_nothing() -> None:
    project = pto.loads(b"p f0 w200 h100 v80 S0,100,0,50\np S1,90,2,40\ni w5\n")
    assert project.panorama.crop == (1, 2, 90, 40)


@pytest.mark.parametrize(("key", "left"), [("S", b"f0 w200 h100 v80"), ("v", b"f0 w200 h100 S0,100,0,50")])
def test_what_is_removed_is_removed_from_both_p_lines(key: str, left: bytes) -> None:
    """And one of the geometry can be given a value."""
    line = b"p f0 w200 h100 v80 S0,100,0,50\n"
    project = pto.loads(line + line + b"i w5\n")
    project.panorama.set(key, None)
    assert project.panorama.get(key) is None
    assert pto.dumps(project) == b"p " + left + b"\np " + left + b"\ni w5\n"
    project.panorama.height = 50
    assert project.panorama.height == 50


def test_the_crop_factor_is_looked_at_where_somebody_asks() -> None:
    project = pto.loads(b"p w9\n#-hugin  cropFactor=big disabled\ni w5\n")
    (image,) = project.images
    assert image.disabled and image.hugin is not None
    with pytest.raises(PtoError, match="a number after 'cropFactor'"):
        _ = image.hugin.crop_factor


def test_the_error_reaches_another_process() -> None:
    """Exceptions are pickled on their way; one that cannot be read there breaks a pool of processes."""
    error = pickle.loads(pickle.dumps(PtoError("x.pto", 5, "w", "a number")))
    assert type(error) is PtoError
    assert (error.file, error.line, error.token, error.expected) == ("x.pto", 5, "w", "a number")
    assert str(error) == "x.pto, line 5: found 'w', expected a number"


@pytest.mark.parametrize(
    ("line", "token"),
    [
        (b"p w0", "w0"), (b"p v-5", "v-5"), (b"p S1,2,3", "S1,2,3"), (b'p P"1 x"', 'P"1 x"'), (b"p Rx", "Rx"),
        (b"p Snan,1,2,3", "Snan,1,2,3"),
    ],
)  # fmt: skip
def test_p_lines(line: bytes, token: str) -> None:
    with pytest.raises(PtoError) as caught:
        pto.loads(b"\xef\xbb\xbf# x\n" + line)
    assert (caught.value.line, caught.value.token) == (2, token)


@pytest.mark.parametrize("data", [b"", b"\xef\xbb\xbf", b"Dear reader,\npoints of interest\n", b"*\n"])
def test_what_is_no_project_at_all(data: bytes) -> None:
    with pytest.raises(PtoError, match="a p-line and an i-line") as caught:
        pto.loads(data)
    assert caught.value.line == 0


def test_a_picture_is_told_as_such() -> None:
    """Photos are dropped on the program, too."""
    with pytest.raises(PtoError, match=r"a\.jpg: found 'JPEG', expected a project; name the \.pto") as caught:
        pto.loads(b"\xff\xd8\xff\xe0\0\x10JFIF\0", "a.jpg")
    assert caught.value.line == 0


def test_of_what_is_no_project_little_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A video, larger than memory, and a log."""
    with (tmp_path / "clip.mp4").open("wb") as video:
        video.truncate(1 << 40)
    with pytest.raises(PtoError, match=r"clip\.mp4, line 1: .* without NUL bytes"):
        pto.load(tmp_path / "clip.mp4")
    (tmp_path / "log").write_bytes(b"c\n" * 5000)
    monkeypatch.setattr(pto.parser, "_LARGEST", 9999)
    with pytest.raises(PtoError, match=r"log: found 'more than .* MiB', expected a project; name the \.pto"):
        pto.load(tmp_path / "log")


def test_utf16_is_refused_by_its_nul_bytes() -> None:
    with pytest.raises(PtoError, match="NUL") as caught:
        pto.loads(HUGIN.decode().encode("utf-16"))
    assert caught.value.line == 1


def test_a_long_token_is_cut_in_the_message() -> None:
    with pytest.raises(PtoError) as caught:
        pto.loads(b"p w" + b"1" * 1_000_000)
    assert len(str(caught.value)) < 500


def test_a_circle_through_several_images_and_one_key_only() -> None:
    with pytest.raises(PtoError, match="circle") as caught:
        pto.loads(b"p\ni v1 a=1\ni a=2 v=0\ni a=0 v=0\n")
    assert (caught.value.line, caught.value.token) == (4, "a=0")


def test_long_chains_are_no_recursion() -> None:
    count = 20_001
    chain = b"p\n" + b"".join(b"i v=%d\n" % (index + 1) for index in range(count)) + b"i v7.5\n"
    assert pto.loads(chain).images[0].variable("v") == 7.5


REFUSED_EDITS = [
    ("v", "wide"),
    ("v", "1 y5"),
    ("v", float("nan")),
    ("v", 10**400),
    ("v", "=9"),
    ("v", "=2"),  # image 2 links to 1 links to 0
    ("w", 1.5),
    ("w", -1),
    ("n", 'a"b'),
    ("n", "a\nb"),
    ("n", "a\0b"),
    ("n", "\ud800"),
    ("S", "1,2,3"),
    ("Zz", "a b"),
    ("wi", "de"),
    ("", "5"),
    ("a b", "5"),
]


@pytest.mark.parametrize(("key", "value"), REFUSED_EDITS)
def test_an_edit_that_could_not_be_read_again_changes_nothing(key: str, value: str | float) -> None:
    project = pto.loads(HUGIN)
    with pytest.raises(PtoError):
        project.images[0].set(key, value)
    assert pto.dumps(project) == HUGIN
    assert project.images[2].variable("v") == 54.25


def test_other_edits_that_are_refused() -> None:
    project = pto.loads(HUGIN)
    refused = [
        lambda: setattr(project.control_points[0], "image1", 3),
        lambda: setattr(project.control_points[0], "image2", -1),
        lambda: project.control_points[0].set("x", None),
        lambda: setattr(project.masks[0], "image", 3),
        lambda: setattr(project.masks[0], "type", 9),
        lambda: setattr(project.variables[0], "entries", [("y", 3)]),
        lambda: setattr(project.variables[0], "entries", [("y z", 1)]),
        lambda: project.options.update(blender="a\nb"),
        lambda: project.options.update(blender=" a"),
        lambda: project.options.update({"a b": "c"}),
        lambda: project.options.update({"é": "c"}),
        lambda: project.panorama.set("w", 0),
    ]
    for edit in refused:
        with pytest.raises(PtoError):
            edit()
        assert pto.dumps(project) == HUGIN
    bare = pto.loads(b"p\ni w5\n")
    with pytest.raises(PtoError, match="#-hugin"):
        bare.images[0].disabled = True


def test_a_big_project_is_read_by_the_fast_patterns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines as Hugin writes them are never taken apart token by token: that is what makes reading fast."""
    points = b"c n0 N1 x10.25 y20.5 X30.125 Y-4e-05 t0\n" * 1001
    image = re.search(rb"^i .*\n", HUGIN, re.MULTILINE)
    assert image

    def scanned(*_: object) -> None:
        raise AssertionError("a plain line was scanned")

    monkeypatch.setattr(grammar, "scan", scanned)
    project = pto.loads(b"p\n".replace(b"p", b"i w5") + image[0] * 101 + points)
    assert len(project.control_points) == 1001
    assert not any(isinstance(line, pto.ControlPoint) for line in project.lines), "made before anyone asked"
    assert project.control_points[1000].y2 == -4e-05
    assert sum(isinstance(line, pto.ControlPoint) for line in project.lines) == 1
