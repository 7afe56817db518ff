"""Bytes to `Project`: Hugin's .pto and the scripts of PTGui, PTMac and the panotools.

Every line is kept as its bytes; lines with a meaning are read at once, so that a malformed one is found
here and not in the middle of the work. Only control points stay bytes until they are asked for.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from hugin_abflow.errors import ProjectError, PtoError
from hugin_abflow.formats import picture_format
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
# PTGui counts its dummy image in c- and v-lines since this file version (Hugin's Panorama.cpp).
_FIRST_VERSION_COUNTING_THE_DUMMY = 8


def load(path: str | Path) -> Project:
    """Read a project file.

    Raises `PtoError` for a malformed one, `ProjectError` for one that cannot be read.
    """
    try:
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise ProjectError(f"{path}: cannot be read ({reason}); check name and permissions") from error
    return loads(data, str(path))


def loads(data: bytes, file: str = "<bytes>") -> Project:
    """Read a project from the bytes of its file; `file` names it in messages.

    Raises `PtoError` for a malformed line, a link, control point, mask or variable of an image that is not
    there, links in a circle, and for data that is no such text at all: one with NUL bytes or without both a
    p-line and an image.
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
        """Read all lines up to the ``*``, put the images together, check what refers to them.

        There may be hundreds of thousands of control points: one as Hugin writes it is only matched.
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
                point = lines[position] = ControlPoint(project, position + 1, raw)
                numbers.update((point.value("n") or b"", point.value("N") or b""))
                positions.append(position)
            elif letter == b"#":
                lines[position] = self.read_comment(position + 1, raw) or raw
            elif letter == b"*":
                project.end = position
                break
            elif letter in self.read_line and grammar.is_line(raw, letter):
                lines[position] = self.read_line[letter](position + 1, raw)
        project.added = [line for line in (project.panorama, project.modes) if not line.number]
        self.join_images()
        self.check()
        self.check_control_points(numbers)
        return project

    def read_panorama(self, number: int, raw: bytes) -> Line:
        """The p-line."""
        self.refuse_second(self.project.panorama, number, raw)
        self.project.panorama = Panorama(self.project, number, raw)
        return self.project.panorama

    def read_modes(self, number: int, raw: bytes) -> Line:
        """The m-line."""
        self.refuse_second(self.project.modes, number, raw)
        self.project.modes = Modes(self.project, number, raw)
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

    def refuse_second(self, earlier: Line, number: int, raw: bytes) -> None:
        """Raise `PtoError` where the file has had such a line already."""
        if earlier.number:
            kind = earlier.head.decode()
            expected = f"one {kind}-line (the first is line {earlier.number})"
            raise PtoError(self.project.file, number, grammar.show(raw.rstrip()), expected)

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
        """Raise `PtoError` for what refers to nothing, and for a text that is no project."""
        project = self.project
        if not project.panorama.number and not project.images:
            expected = "a .pto text, with a p-line and an i-line for each image"
            first = project.lines[0] if project.lines else b""
            token = first.raw if isinstance(first, Line) else first
            raise PtoError(project.file, 0, grammar.show(token.rstrip()), expected)
        project.check_links()
        for line in (*project.masks, *project.variables):
            line.check()

    def check_control_points(self, numbers: set[bytes]) -> None:
        """Raise `PtoError` for the first control point with one of `numbers` that is no image's."""
        first = self.project.first_number
        if not all(first <= int(number) < first + self.project.image_count for number in numbers):
            for point in self.project.control_points:
                point.check()
