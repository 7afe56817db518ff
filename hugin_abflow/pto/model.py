"""The Hugin project: panorama, images, control points, masks, options."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping, Sequence
from typing import overload

from hugin_abflow.errors import PtoError
from hugin_abflow.pto import grammar
from hugin_abflow.pto.fields import Box, Line, Text, Whole, decode
from hugin_abflow.pto.lines import (
    ControlPoint,
    HuginLine,
    ImageFileLine,
    ImageLine,
    Mask,
    Modes,
    OptionLine,
    Panorama,
    VariableLine,
)


class Image:
    """A photo: an i-line with the o-line, ``#-hugin`` and ``#-imgfile`` lines that belong to it.

    index       its index in `Project.images`, as in the layers' names; -1 for PTGui's dummy image.
    lines       the image's i-line and, in older scripts, its o-line.
    hugin       its ``#-hugin`` line, if the file has one for every image.
    file_line   its ``#-imgfile`` line, if the file has one for every image.
    """

    __slots__ = ("file_line", "hugin", "index", "lines", "project")

    def __init__(self, project: Project, index: int, lines: tuple[ImageLine, ...]) -> None:
        self.project, self.index, self.lines = project, index, lines
        self.hugin: HuginLine | None = None
        self.file_line: ImageFileLine | None = None

    filename = Text("n", "", "Name of the photo's file as it stands in the project; may be relative (n).")
    width = Whole("w", 0, "Width of the photo in pixels; 0: not given (w).")
    height = Whole("h", 0, "Height of the photo in pixels; 0: not given (h).")
    projection = Whole("f", 0, "The lens: 0 rectilinear, 2 circular fisheye, 3 full-frame fisheye ... (f).")

    def __repr__(self) -> str:
        return f"<Image {self.index}: {self.filename!r}>"

    def get(self, key: str) -> str | None:
        """The value of a field as text, without quotes: ``=0`` for a link; None where it is not given."""
        return self._line_of(key).get(key)

    def set(self, key: str, value: str | float | None) -> None:
        """Give a field a value where it stands in the file; None removes it; ``=N`` makes a link.

        Raises `PtoError`, and changes nothing, for a value that could not be read again, a link to an image
        that is not there, or one that closes a circle.
        """
        line = self._line_of(key)
        before = line.raw
        line.set(key, value)
        try:
            self.project.link_end(self, key)
        except PtoError:
            line.replace(before)
            raise

    def number_of(self, key: str, default: float) -> float:
        """A field as a number. Raises `PtoError` where it holds something else."""
        return self._line_of(key).number_of(key, default)

    def whole(self, key: str, default: int) -> int:
        """A field as a whole number. Raises `PtoError` where it holds something else."""
        return self._line_of(key).whole(key, default)

    def variable(self, name: str) -> float:
        """The value of an image variable, such as ``v`` or ``Eev``, through all links.

        One that is not given has Hugin's default. Raises `PtoError` for a field that is no number.
        """
        return self.project.link_end(self, name).number_of(name, grammar.VARIABLE_DEFAULTS.get(name, 0.0))

    def link(self, name: str) -> int | None:
        """The image number N of ``name=N`` as the file counts (see `Project.linked_image`), else None."""
        line = self.lines[0] if len(self.lines) == 1 else self._line_of(name)
        return line.links.get(name) if isinstance(line, ImageLine) else None

    @property
    def disabled(self) -> bool:
        """Whether the image takes no part in the panorama."""
        return self.hugin is not None and self.hugin.disabled

    @disabled.setter
    def disabled(self, value: bool) -> None:
        if self.hugin is None:
            raise self.lines[0].error(self.lines[0].raw.rstrip(), "a '#-hugin' line for every image")
        self.hugin.disabled = value

    @property
    def stack(self) -> int:
        """Number of the stack (j), through all links.

        Hugin numbers nothing with it: images belong together where their j is *linked*; see
        `Project.stacks`.
        """
        return int(self.variable("j"))

    @property
    def crop(self) -> Box | None:
        """The used part of the photo (S or C): left, top, right, bottom, the latter two exclusive.

        It may exceed the photo. None where there is none or, as Hugin has it, an empty one.
        """
        box = self._line_of("S").box("S") or self._line_of("C").box("C")
        return box if box and box[0] < box[2] and box[1] < box[3] else None

    @crop.setter
    def crop(self, value: Box | None) -> None:
        key = "C" if self.get("S") is None and self.get("C") is not None else "S"
        self._line_of(key).set_box(key, value)

    @property
    def masks(self) -> list[Mask]:
        """The masks drawn in this image."""
        return [mask for mask in self.project.masks if mask.image == self.index]

    def links(self) -> frozenset[str]:
        """The keys of all fields that are links on one of the image's lines."""
        return frozenset(key for line in self.lines for key in line.links)

    def link_error(self, key: str, expected: str) -> PtoError:
        """The error for a link of this image that leads nowhere."""
        return self._line_of(key).error(f"{key}={self.link(key)}", expected)

    def _line_of(self, key: str) -> ImageLine | ImageFileLine:
        """The line that a field is read from and written to.

        As in Hugin: ``#-imgfile`` first, then the i-line, except where only the o-line has the field or
        only there it is a link.
        """
        if self.file_line is not None and key in ("w", "h", "n"):
            return self.file_line
        for line in self.lines[1:]:
            if line.value(key) is None:
                continue
            linked_only_here = key in line.links and key not in self.lines[0].links
            if linked_only_here or self.lines[0].value(key) is None:
                return line
        return self.lines[0]


class ControlPoints(Sequence[ControlPoint]):
    """The control points, in order; each is made when it is first asked for.

    A project can hold hundreds of thousands that nobody looks at.
    """

    def __init__(self, project: Project) -> None:
        self.positions: list[int] = []  # where they stand in `Project.lines`
        self._project = project

    def __len__(self) -> int:
        return len(self.positions)

    @overload
    def __getitem__(self, index: int) -> ControlPoint: ...
    @overload
    def __getitem__(self, index: slice) -> list[ControlPoint]: ...
    def __getitem__(self, index: int | slice) -> ControlPoint | list[ControlPoint]:
        if isinstance(index, slice):
            return [self._at(position) for position in self.positions[index]]
        return self._at(self.positions[index])

    def _at(self, position: int) -> ControlPoint:
        line = self._project.lines[position]
        if isinstance(line, ControlPoint):
            return line
        raw = line if isinstance(line, bytes) else line.raw
        point = self._project.lines[position] = ControlPoint(self._project, position + 1, raw)
        return point


class Options(MutableMapping[str, str]):
    """The ``#hugin_*`` lines by their names without ``#hugin_``.

    Of an option given twice the last one counts. An empty value keeps the default: such an option is
    not in the mapping. Deleting an option empties its value.
    """

    def __init__(self, project: Project) -> None:
        self.lines: list[OptionLine] = []
        self._project = project

    def _given(self) -> dict[str, OptionLine]:
        return {line.name: line for line in self.lines if line.text}

    def __getitem__(self, name: str) -> str:
        return self._given()[name].text

    def __setitem__(self, name: str, value: str) -> None:
        same = [line for line in self.lines if line.name == name]
        if not value:
            for line in same:
                line.text = ""
        elif same:
            self._given().get(name, same[-1]).text = value
        else:
            head = f"#hugin_{name}".encode("ascii", "backslashreplace")
            line = OptionLine(self._project, 0, head + self._project.newline)
            if line.name != name:
                raise line.error(name, "an option's name of ASCII letters, digits and '_'")
            line.text = value
            self.lines.append(line)
            self._project.added.append(line)

    def __delitem__(self, name: str) -> None:
        if name not in self._given():
            raise KeyError(name)
        self[name] = ""

    def __iter__(self) -> Iterator[str]:
        return iter(self._given())

    def __len__(self) -> int:
        return len(self._given())

    def __repr__(self) -> str:
        return f"Options({dict(self)})"


class Project:
    """A Hugin project, or a script of a program that speaks the same language.

    file            name of the file that it was read from.
    panorama        the p-line.
    modes           the m-line.
    images          the images, in order; PTGui's dummy image is not among them.
    dummy           PTGui's dummy image, which holds parameters that images link to.
    control_points  the c-lines, in order.
    masks           the k-lines, in order.
    variables       the v-lines, in order.
    options         the ``#hugin_*`` lines.
    first_number    what c- and v-lines call the first image: 0, or 1 where PTGui counts its dummy image.
    lines           the file's lines, in order: a `Line` where a line has a meaning, else its bytes.
    end             how many of `lines` stand before the ``*`` that ends the script, but not for Hugin.
    doubts          what of the file is left out or doubtful, in sentences with file and line.
    added           lines that the file lacks, to be written at its end.
    bom, newline    the UTF-8 byte order mark, if the file has one, and its line end.
    """

    def __init__(self, file: str, bom: bytes, lines: list[bytes | Line]) -> None:
        self.file, self.bom, self.lines, self.end = file, bom, lines, len(lines)
        first = lines[0] if lines else b""
        self.newline = b"\r\n" if isinstance(first, bytes) and first.endswith(b"\r\n") else b"\n"
        self.doubts: list[str] = []
        self.first_number = 0
        self.dummy: Image | None = None
        self.images: list[Image] = []
        self.masks: list[Mask] = []
        self.variables: list[VariableLine] = []
        self.control_points = ControlPoints(self)
        self.options = Options(self)
        # Without a p- or m-line in the file these stay without bytes until a field is set.
        self.panorama, self.modes = Panorama(self, 0, b""), Modes(self, 0, b"")
        self.added: list[Line] = []

    def __repr__(self) -> str:
        return (
            f"<Project {self.file!r}: {len(self.images)} images, {len(self.control_points)} control points>"
        )

    @property
    def image_count(self) -> int:
        """Number of images."""
        return len(self.images)

    @property
    def comments(self) -> list[str]:
        """All lines without a meaning to this model: comments, unknown lines, those that are left out."""
        points = set(self.control_points.positions)
        plain = (line for at, line in enumerate(self.lines) if isinstance(line, bytes) and at not in points)
        return [text for text in (decode(line).strip() for line in plain) if text]

    @property
    def stacks(self) -> list[list[Image]]:
        """The images by stacks: images belong together where their stack numbers (j) are linked."""
        stacks: dict[int, list[Image]] = {}
        for image in self.images:
            stacks.setdefault(self.link_end(image, "j").index, []).append(image)
        return list(stacks.values())

    def option(self, name: str, default: str) -> str:
        """The value of ``#hugin_name``; `default` where it is absent or empty."""
        return self.options.get(name, default)

    def linked_image(self, number: int) -> Image | None:
        """The image that a link ``=number`` means; None where there is none. PTGui's 0 is its dummy image."""
        numbered = self.images if self.dummy is None else [self.dummy, *self.images]
        return numbered[number] if number < len(numbered) else None

    def link_end(self, image: Image, key: str) -> Image:
        """The image at the end of a chain of links. Raises `PtoError` for a missing image or a circle."""
        return self._follow(image, key, set())

    def check_links(self) -> None:
        """Raise `PtoError` for the first link to a missing image or in a circle."""
        checked: set[tuple[int, str]] = set()
        for image in self.images if self.dummy is None else [self.dummy, *self.images]:
            for key in image.links():
                self._follow(image, key, checked)

    def _follow(self, image: Image, key: str, checked: set[tuple[int, str]]) -> Image:
        """Follow links until a value or a `checked` image, and note the way there as checked."""
        way: dict[int, None] = {}
        while (number := image.link(key)) is not None and (image.index, key) not in checked:
            way[image.index] = None
            target = self.linked_image(number)
            if target is None:
                raise image.link_error(key, f"a link to one of the {len(self.images)} images")
            if target.index in way:
                raise image.link_error(key, "links that end at a value, not in a circle")
            image = target
        checked.update((index, key) for index in way)
        return image
