"""Bytes to `Project`: Hugin's .pto and the scripts of PTGui, PTMac and the panotools.

Every line is kept as its bytes; lines with a meaning are read at once, so that a malformed one is found
here and not in the middle of the work. Only control points stay bytes until they are asked for. Malformed
lines that Hugin's nona does without are left out: where it makes layers, there is a panorama to be made.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hugin_abflow.errors import ProjectError, PtoError
from hugin_abflow.formats import holds_text, picture_format
from hugin_abflow.pto import grammar
from hugin_abflow.pto.fields import Line
from hugin_abflow.pto.lines import (
    ControlPoint,
    HuginLine,
    ImageFileLine,
    ImageLine,
    Mask,
    Modes,
    OptionLine,
    OutputImageLine,
    Panorama,
    VariableLine,
)
from hugin_abflow.pto.model import Image, Project

_BOM = b"\xef\xbb\xbf"
_FILE_VERSION = re.compile(rb"#-fileversion[ \t]+(\d{1,9})(?!\S)")
# A project of thousands of photos has some tens of MiB. Videos lie beside projects, and devices never end.
_LARGEST = 64 << 20
_BEGINNING = 1 << 16  # of what is no text, no more is read
# PTGui counts its dummy image in c- and v-lines since this file version (Hugin's Panorama.cpp).
_FIRST_VERSION_COUNTING_THE_DUMMY = 8


def load(path: str | Path) -> Project:
    """Read a project file.

    Raises `PtoError` for a malformed one and for what is too large to be one, `ProjectError` for one that
    cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(_BEGINNING)
            if holds_text(data):
                data += file.read(_LARGEST + 1 - len(data))
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise ProjectError(f"{path}: cannot be read ({reason}); check name and permissions") from error
    if len(data) > _LARGEST:
        expected = "a project; name the .pto that Hugin saved"
        raise PtoError(str(path), 0, f"more than {_LARGEST >> 20} MiB", expected)
    return loads(data, str(path))


def loads(data: bytes, file: str = "<bytes>") -> Project:
    """Read a project from the bytes of its file; `file` names it in messages.

    Malformed control points, masks and variables are left out, which `Project.doubts` tells. Raises
    `PtoError` for other malformed lines, a link to or a variable of an image that is not there, at which nona
    ends, too, links in a circle, and for data that is no such text at all: one with NUL bytes or without both
    a p-line and an image.
    """
    nul = data.find(b"\0")
    if nul >= 0 and (kind := picture_format(data)):
        raise PtoError(file, 0, kind, "a project; name the .pto that Hugin saved, not a picture")
    if nul >= 0:
        line = len(data[: nul + 1].splitlines())
        raise PtoError(file, line, "\0", "a .pto text in an 8-bit encoding such as UTF-8, without NUL bytes")
    bom = _BOM if data.startswith(_BOM) else b""
    return _Reader(Project(file, bom, list(data[len(bom) :].splitlines(keepends=True)))).read()


class _Reader:
    """Reads the lines of one project."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self.input_lines: list[ImageLine] = []  # i
        self.output_lines: list[ImageLine] = []  # o
        self.hugin_lines: list[HuginLine] = []
        self.file_lines: list[ImageFileLine] = []
        self.dummy_follows = False
        self.file_version: int | None = None
        self.read_line: dict[bytes, Callable[[int, bytes], Line]] = {
            b"p": self.read_panorama,
            b"m": self.read_modes,
            b"i": self.read_input_image,
            b"o": self.read_output_image,
            b"k": self.read_mask,
            b"v": self.read_variables,
        }

    def read(self) -> Project:
        """Read all lines, put the images together, check what refers to them.

        There may be hundreds of thousands of control points: one as Hugin writes it is only matched. The
        ``*`` at which panotools stop reading is nothing to Hugin: lines behind it count as those before.
        """
        project = self.project
        lines = project.lines
        plain_control_point = grammar.PLAIN_CONTROL_POINT.fullmatch
        positions = project.control_points.positions
        numbers: set[bytes] = set()  # of images, in control points
        for position, raw in enumerate(lines):
            assert isinstance(raw, bytes)
            letter = raw[:1]
            if letter == b"c" and (match := plain_control_point(raw)):
                numbers.update(match.groups())
                positions.append(position)
            elif letter == b"c" and grammar.is_line(raw, letter):
                with self.left_out():
                    point = lines[position] = ControlPoint(project, position + 1, raw)
                    numbers.update((point.value("n") or b"", point.value("N") or b""))
                    positions.append(position)
            elif letter == b"#":
                lines[position] = self.read_comment(position + 1, raw) or raw
            elif letter == b"*":
                project.end = min(project.end, position)
            elif letter in (b"k", b"v") and grammar.is_line(raw, letter):
                with self.left_out():
                    lines[position] = self.read_line[letter](position + 1, raw)
            elif letter in self.read_line and grammar.is_line(raw, letter):
                lines[position] = self.read_line[letter](position + 1, raw)
        project.added = [line for line in (project.panorama, project.modes) if not line.number]
        self.join_images()
        self.check()
        self.check_control_points(numbers)
        return project

    def read_panorama(self, number: int, raw: bytes) -> Line:
        """The p-line, or another one."""
        self.note_second(self.project.panorama, number)
        self.project.panorama = Panorama(self.project, number, raw, self.project.panorama)
        self.project.panorama.check_beside_earlier()
        return self.project.panorama

    def read_modes(self, number: int, raw: bytes) -> Line:
        """The m-line, or another one."""
        self.note_second(self.project.modes, number)
        self.project.modes = Modes(self.project, number, raw, self.project.modes)
        return self.project.modes

    def read_input_image(self, number: int, raw: bytes) -> Line:
        """An i-line."""
        return self.add_image(ImageLine(self.project, number, raw), self.input_lines)

    def read_output_image(self, number: int, raw: bytes) -> Line:
        """An o-line."""
        return self.add_image(OutputImageLine(self.project, number, raw), self.output_lines)

    def read_mask(self, number: int, raw: bytes) -> Line:
        """A k-line."""
        self.project.masks.append(Mask(self.project, number, raw))
        return self.project.masks[-1]

    def read_variables(self, number: int, raw: bytes) -> Line:
        """A v-line."""
        self.project.variables.append(VariableLine(self.project, number, raw))
        return self.project.variables[-1]

    def read_comment(self, number: int, raw: bytes) -> Line | None:
        """A line that begins with ``#``; None where it is a comment for people."""
        if OptionLine.matches(raw):
            option = OptionLine(self.project, number, raw)
            self.project.options.lines.append(option)
            return option
        word = raw.split(None, 1)[0]
        if word == HuginLine.head:
            self.hugin_lines.append(HuginLine(self.project, number, raw))
            return self.hugin_lines[-1]
        if word == ImageFileLine.head:
            self.file_lines.append(ImageFileLine(self.project, number, raw))
            return self.file_lines[-1]
        if word == b"#-dummyimage":
            self.dummy_follows = True
        elif match := _FILE_VERSION.match(raw):
            self.file_version = int(match[1])
        return None

    def add_image(self, line: ImageLine, lines: list[ImageLine]) -> ImageLine:
        """Note an image line; the one after ``#-dummyimage`` is PTGui's dummy image."""
        if self.dummy_follows:
            self.dummy_follows = False
            if self.project.dummy is not None:
                raise line.error(line.raw.rstrip(), "no second '#-dummyimage'")
            self.project.dummy = Image(self.project, -1, (line,))
        else:
            lines.append(line)
        return line

    @contextmanager
    def left_out(self) -> Iterator[None]:
        """Leave out, and note, a line that is malformed or names an image that is not there."""
        try:
            yield
        except PtoError as error:
            self.project.doubts.append(
                f"{error}: it is left out, though nona may obey it; correct or delete that line"
            )

    def note_second(self, earlier: Line, number: int) -> None:
        """Note where the file has had such a line already."""
        if earlier.number:
            kind = earlier.head.decode()
            self.project.doubts.append(
                f"{self.project.file}, line {number}: line {earlier.number} is a {kind}-line, too; what both "
                "give is taken from the later, as in Hugin; delete one"
            )

    def join_images(self) -> None:
        """Make the images: the i-, o-, ``#-hugin`` and ``#-imgfile`` lines of the same index.

        Of the latter two there must be one for every image; otherwise nobody knows whose they are.
        """
        project = self.project
        both = min(len(self.input_lines), len(self.output_lines))
        pairs: list[tuple[ImageLine, ...]] = list(zip(self.input_lines, self.output_lines, strict=False))
        singles = self.input_lines[both:] + self.output_lines[both:]
        for index, lines in enumerate([*pairs, *((line,) for line in singles)]):
            project.images.append(Image(project, index, lines))
        if len(self.hugin_lines) == project.image_count:
            for image, hugin in zip(project.images, self.hugin_lines, strict=True):
                image.hugin = hugin
        if len(self.file_lines) == project.image_count:
            for image, file_line in zip(project.images, self.file_lines, strict=True):
                image.file_line = file_line
        counts_dummy = self.file_version is None or self.file_version >= _FIRST_VERSION_COUNTING_THE_DUMMY
        project.first_number = 1 if project.dummy is not None and counts_dummy else 0

    def check(self) -> None:
        """Raise `PtoError` for what refers to nothing, but masks, and for a text that is no project."""
        project = self.project
        if not project.panorama.number and not project.images:
            expected = "a .pto text, with a p-line and an i-line for each image"
            first = project.lines[0] if project.lines else b""
            token = first.raw if isinstance(first, Line) else first
            raise PtoError(project.file, 0, grammar.show(token.rstrip()), expected)
        project.check_links()
        for line in project.variables:
            line.check()
        masks, project.masks = project.masks, []
        for mask in masks:
            with self.left_out():
                mask.check()
                project.masks.append(mask)

    def check_control_points(self, numbers: set[bytes]) -> None:
        """Leave out control points with one of `numbers` that is no image's."""
        project, first = self.project, self.project.first_number
        if all(first <= int(number) < first + project.image_count for number in numbers):
            return
        points, project.control_points.positions = list(project.control_points), []
        for point in points:
            with self.left_out():
                point.check()
                project.control_points.positions.append(point.number - 1)
