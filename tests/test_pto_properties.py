"""Properties: any bytes are a project or a `PtoError`; any field can be edited and is read again."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hugin_abflow import pto
from hugin_abflow.errors import PtoError
from hugin_abflow.pto import grammar
from hugin_abflow.pto.fields import FieldLine

CORPUS = Path(__file__).parent / "pto_corpus"
SAMPLES = [path.read_bytes() for path in sorted(CORPUS.iterdir())]
HUGIN = (CORPUS / "hugin.pto").read_bytes()

LINE_STARTS = [b"p ", b"i ", b"o ", b"c ", b"k ", b"v ", b"m ", b"*", b"# ptGui project file\n"]
COMMENT_STARTS = [b"#hugin_", b"#-hugin ", b"#-imgfile ", b"#-dummyimage", b"#-fileversion 8\n"]
FIELD_TEXTS = [b"w5", b"v=0", b"v=1", b"n0 N1 x1 y2 X3 Y4 t0", b'n"a b"', b"y0", b'p"1 2"', b"S1,2,3,4"]
ODDITIES = [
    b'"',
    b"=",
    b"e999",
    b"9" * 5000,
    b"nan",
    b"\n",
    b"\r",
    b"\r\n",
    b" ",
    b"\t",
    b"\xff",
    b"\xef\xbb\xbf",
]
SNIPPETS = st.sampled_from([*LINE_STARTS, *COMMENT_STARTS, *FIELD_TEXTS, *ODDITIES])


THOROUGH = settings(max_examples=60)
BRIEF = settings(THOROUGH, max_examples=10)


def read_everything(data: bytes) -> pto.Project | None:
    """Load, look at every part of the model, write; None where the bytes are no project."""
    try:
        project = pto.loads(data)
    except PtoError as error:
        assert 0 <= error.line <= len(data.splitlines())
        assert str(error)
        return None
    assert pto.dumps(project) == data
    panorama = project.panorama
    assert panorama.width > 0 and panorama.height > 0 and panorama.hfov > 0
    assert isinstance((panorama.crop, panorama.exposure, panorama.hdr, panorama.output_format), tuple)
    for image in project.images:
        assert all(math.isfinite(image.variable(name)) for name in grammar.VARIABLES)
        assert isinstance((image.filename, image.crop, image.disabled, image.stack), tuple)
        assert all(mask.image == image.index for mask in image.masks)
    for point in project.control_points:
        assert 0 <= point.image1 < len(project.images) > point.image2 >= 0
        assert all(math.isfinite(value) for value in (point.x1, point.y1, point.x2, point.y2))
    assert all(isinstance(line.entries, list) for line in project.variables)
    assert dict(project.options) == {name: project.options[name] for name in project.options}
    assert sum(map(len, project.stacks)) == len(project.images)
    assert pto.dumps(project) == data
    return project


@THOROUGH
@given(st.binary(max_size=200) | st.lists(SNIPPETS | st.binary(max_size=3), max_size=30).map(b"".join))
def test_any_bytes_are_a_project_or_an_error(data: bytes) -> None:
    read_everything(data)
    read_everything(b"p\ni w5\ni w6\n" + data)


@THOROUGH
@given(st.data())
def test_damaged_projects_are_a_project_or_an_error(data: st.DataObject) -> None:
    text = data.draw(st.sampled_from(SAMPLES))
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text)))
        removed = data.draw(st.integers(0, 5))
        text = text[:start] + data.draw(SNIPPETS | st.binary(max_size=2)) + text[start + removed :]
    read_everything(text)


def _is_written_bare(text: str) -> bool:
    return not set(text) & set('"\r\n\0')


numbers = st.floats(allow_nan=False, allow_infinity=False)
coordinates = st.integers(-999_999_999, 999_999_999)
texts = st.text(max_size=20).filter(_is_written_bare)
lists = st.lists(numbers.map(repr), max_size=5)
VALUES: dict[grammar.ValueType, st.SearchStrategy[str | float]] = {
    grammar.INDEX: st.integers(0, 999_999_999),
    grammar.WHOLE: coordinates,
    grammar.SIZE: st.integers(1, 999_999_999),
    grammar.NUMBER: numbers,
    grammar.POSITIVE: numbers.filter(lambda value: value > 0),
    grammar.LINKABLE: numbers,
    grammar.BOX: st.lists(coordinates.map(str), min_size=4, max_size=4).map(",".join),
    grammar.TEXT: texts,
    grammar.PIXEL_TYPE: texts,
    grammar.NUMBERS: lists.map(" ".join),
    grammar.POINTS: lists.map(lambda items: " ".join(items + items)),
    grammar.MASK_TYPE: st.integers(0, 4),
    grammar.FLAG: st.just(""),
}
LINES = {b"p": 3, b"m": 4, b"i": 8, b"c": 21, b"k": 23}  # a line of each kind in hugin.pto, from 1


def line_at(project: pto.Project, number: int) -> FieldLine:
    """The line of that number; a control point is made by looking at it."""
    list(project.control_points)
    line = project.lines[number - 1]
    assert isinstance(line, FieldLine) and line.number == number
    return line


FIELDS = [
    (number, key, kind)
    for number, keys in zip(
        LINES.values(),
        (grammar.PANORAMA, grammar.MODES, grammar.IMAGE, grammar.CONTROL_POINT, grammar.MASK),
        strict=True,
    )
    for key, kind in keys.types.items()
]


@pytest.mark.parametrize(("number", "key", "kind"), FIELDS, ids=[f"{n}-{key}" for n, key, _ in FIELDS])
@BRIEF
@given(data=st.data(), crlf=st.booleans())
def test_every_field_of_every_line_is_edited_and_read_again(
    number: int, key: str, kind: grammar.ValueType, data: st.DataObject, crlf: bool
) -> None:
    text = HUGIN.replace(b"\n", b"\r\n") if crlf else HUGIN
    project = pto.loads(text)
    is_image_number = (key in "nN" and number == LINES[b"c"]) or (key == "i" and number == LINES[b"k"])
    value = data.draw(st.integers(0, 2) if is_image_number else VALUES[kind])
    line_at(project, number).set(key, value)
    written = pto.dumps(project)
    read = line_at(pto.loads(written), number).get(key)
    assert read is not None
    assert (float(read) if isinstance(value, int | float) else read) == value

    old, new = text.splitlines(), written.splitlines()
    assert [at for at, pair in enumerate(zip(old, new, strict=True), 1) if pair[0] != pair[1]] in (
        [],
        [number],
    )
    before, after = line_at(pto.loads(text), number), line_at(pto.loads(written), number)
    others = [name for name in before.keys.types if name != key]
    assert [after.value(name) for name in others] == [before.value(name) for name in others]

    if key not in before.keys.required:
        line_at(project, number).set(key, None)
        again = line_at(pto.loads(pto.dumps(project)), number)
        assert again.get(key) is None
        assert [again.value(name) for name in others] == [before.value(name) for name in others]


@THOROUGH
@given(st.integers(0, 2), st.integers(0, 2), st.sampled_from(grammar.VARIABLES), numbers)
def test_links_are_set_and_resolved_or_refused_as_a_circle(a: int, b: int, name: str, value: float) -> None:
    project = pto.loads(b"p\ni w5\ni w6\ni w7\n")
    images = project.images
    images[b].set(name, value)
    if a == b:
        with pytest.raises(PtoError, match="circle"):
            images[a].set(name, f"={b}")
        return
    images[a].set(name, f"={b}")
    again = pto.loads(pto.dumps(project)).images
    assert again[a].link(name) == b
    assert again[a].variable(name) == again[b].variable(name) == value
    with pytest.raises(PtoError, match="circle"):
        images[b].set(name, f"={a}")
    assert images[a].variable(name) == value


entries = st.lists(st.tuples(st.sampled_from(grammar.VARIABLES), st.integers(0, 2)), max_size=5)


@THOROUGH
@given(entries, st.sampled_from([0, 1, 2]))
def test_variables_are_edited_and_read_again(value: list[tuple[str, int]], index: int) -> None:
    project = pto.loads(HUGIN)
    project.variables[index].entries = value
    written = pto.dumps(project)
    assert pto.loads(written).variables[index].entries == value
    assert len(written.splitlines()) == len(HUGIN.splitlines())
    project.variables[index].entries = pto.loads(HUGIN).variables[index].entries
    assert pto.loads(pto.dumps(project)).variables[index].entries == project.variables[index].entries


option_texts = texts.map(lambda text: text.encode().strip().decode())


@THOROUGH
@given(st.sampled_from(["blender", "enblendOptions", "outputImageType", "brandNew_1"]), option_texts)
def test_options_are_edited_and_read_again(name: str, value: str) -> None:
    project = pto.loads(HUGIN)
    project.options[name] = value
    assert pto.loads(pto.dumps(project)).option(name, "") == value


@THOROUGH
@given(st.booleans(), numbers, texts, st.integers(0, 999_999_999))
def test_comment_lines_are_edited_and_read_again(
    disabled: bool, factor: float, name: str, width: int
) -> None:
    project = pto.loads(HUGIN)
    image = project.images[1]
    assert image.hugin is not None
    image.disabled = disabled
    image.hugin.crop_factor = factor
    again = pto.loads(pto.dumps(project)).images[1]
    assert again.hugin is not None
    assert (again.disabled, again.hugin.crop_factor) == (disabled, factor)

    ptgui = pto.load(CORPUS / "ptgui.pts")
    ptgui.images[1].filename = name
    ptgui.images[1].width = width
    again = pto.loads(pto.dumps(ptgui)).images[1]
    assert (again.filename, again.width, again.height) == (name, width, 127)


@THOROUGH
@given(
    st.lists(
        st.sampled_from([b"v1", b"v=0", b"w5", b'n"a b"', b'n"x"w3', b"y-1.5e-3", b"Zz9", b"v2", b"S1,2,3,4"])
    )
)
def test_plain_lines_are_read_as_token_by_token(fields: list[bytes]) -> None:
    """The fast way gives exactly what the careful one gives."""
    text = b" ".join([b"i", *fields]) + b"\n"
    plain = grammar.IMAGE.read_plain(text, 1)
    slow: dict[str, bytes] = {}
    for field in grammar.scan(grammar.IMAGE, text, 1, "x", 1):
        slow.setdefault(field.key, text[field.value_start : field.end])
    careful_only = {b'n"x"w3', b"Zz9"}
    assert (plain is None) == bool(careful_only & set(fields))
    assert plain is None or plain == slow
