"""The lines of a .pto file, one class for each kind; see `grammar` for their keys."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Self

from hugin_abflow.pto import grammar
from hugin_abflow.pto.fields import Box, FieldLine, Line, Number, Owner, Text, Whole, decode

_OPTION = re.compile(rb"#hugin_(\w+)(?!\S)[ \t]*")
_IMAGE_FILE_FIELDS = (("w", grammar.INDEX), ("h", grammar.INDEX), ("n", grammar.TEXT))


class MergedLine(FieldLine):
    """A line that a project has once. Of fields that it lacks, those of an earlier one count."""

    __slots__ = ("earlier",)

    def __init__(self, owner: Owner, number: int, raw: bytes, earlier: Self | None = None) -> None:
        self.earlier = earlier if earlier and earlier.number else None
        super().__init__(owner, number, raw)

    def read(self) -> None:
        """Take in the fields, and those of the earlier line."""
        super().read()
        if self.earlier:
            self._values = self.earlier._values | self._values

    def set(self, key: str, value: str | float | None) -> None:
        """Give a field a value in the line that it is taken from; None removes it from all."""
        given = any(field.key == key for field in self.scan())
        if self.earlier and self.earlier.get(key) is not None and (value is None or not given):
            self.earlier.set(key, value)
            self.read()
            if not given:
                return
        super().set(key, value)


class Panorama(MergedLine):
    """The p-line: the output. What it lacks has the default of Hugin's PanoramaOptions."""

    __slots__ = ()
    keys, head = grammar.PANORAMA, b"p"
    # Hugin changes some of them along with others, and scales a crop with the width.
    _GEOMETRY = ("f", "w", "h", "v")

    def check_beside_earlier(self) -> None:
        """Raise `PtoError` for a second line by which Hugin would change what only the first one gives."""
        if self.earlier is None:
            return
        given = {field.key for field in self.scan()}
        needed = [*self._GEOMETRY, *(["S"] if self.earlier.get("S") else [])]
        if given.intersection(self._GEOMETRY) and not given.issuperset(needed):
            beside = f"or none but S, beside the p-line in line {self.earlier.number}; delete one of the two"
            raise self.error(self.raw.rstrip(), f"all of {', '.join(needed)}, {beside}")

    projection = Whole("f", 2, "Output projection: 0 rectilinear, 1 cylindrical, 2 equirectangular ... (f).")
    width = Whole("w", 3000, "Width of the canvas in pixels (w).")
    hfov = Number("v", 360.0, "Horizontal field of view in degrees (v).")
    exposure = Number("E", 0.0, "Exposure value of the output, in stops (E).")
    pixel_type = Text("T", "", "Pixel type of the output, such as UINT16; empty: that of the images (T).")
    output_format = Text("n", "TIFF_m c:LZW r:CROP", "Format of the layers, with its options (n).")

    @property
    def height(self) -> int:
        """Height of the canvas in pixels (h); half the width where it is not given."""
        return self.whole("h", max(1, self.width // 2))

    @height.setter
    def height(self, value: int) -> None:
        self.set("h", value)

    @property
    def hdr(self) -> bool:
        """Whether the output is HDR (R is 1)."""
        return self.whole("R", 0) == 1

    @hdr.setter
    def hdr(self, value: bool) -> None:
        self.set("R", int(value))

    @property
    def crop(self) -> Box | None:
        """The part that is output (S): left, top, right, bottom, the latter two exclusive, in pixels.

        None without a crop. As it stands in the file: it may be empty or reach over the canvas.
        """
        return self.box("S")

    @crop.setter
    def crop(self, value: Box | None) -> None:
        self.set_box("S", value)


class Modes(MergedLine):
    """The m-line: how nona and the optimiser work."""

    __slots__ = ()
    keys, head = grammar.MODES, b"m"

    interpolator = Whole("i", 0, "Number of the interpolator: 0 cubic, 1 spline16, 2 spline36 ... (i).")
    gamma = Number("g", 1.0, "Gamma of the calculations (g).")


class ImageLine(FieldLine):
    """An i-line or, in PTGui and older panotools scripts, an o-line: one photo."""

    __slots__ = ("links",)
    keys, head = grammar.IMAGE, b"i"
    links: dict[str, int]  # fields ``key=N``: the image number N, as the file counts

    def read(self) -> None:
        """Take in the fields and which of them are links."""
        super().read()
        equations = ((key, value) for key, value in self._values.items() if value[:1] == b"=")
        # An unknown key may hold anything behind its "="; only a variable is tested to be a link.
        self.links = {key: int(value[1:]) for key, value in equations if key in grammar.VARIABLES}


class OutputImageLine(ImageLine):
    """An o-line."""

    __slots__ = ()
    head = b"o"


class ControlPoint(FieldLine):
    """A c-line: a point seen by two images (or, from type 3 on, two points of a straight line)."""

    __slots__ = ()
    keys, head = grammar.CONTROL_POINT, b"c"

    x1 = Number("x", 0.0, "Column in the first image, in its pixels.")
    y1 = Number("y", 0.0, "Row in the first image, in its pixels.")
    x2 = Number("X", 0.0, "Column in the second image, in its pixels.")
    y2 = Number("Y", 0.0, "Row in the second image, in its pixels.")
    type = Whole("t", 0, "0 point, 1 vertical line, 2 horizontal line, from 3 on: number of a straight line.")

    def check(self) -> None:
        """Raise `PtoError` where the line names an image that is not there."""
        first = self.owner.first_number
        for key in ("n", "N"):
            image = self.whole(key, 0)
            self.check_image(f"{key}{image}", image, first, first + self.owner.image_count)

    @property
    def image1(self) -> int:
        """Index of the first image in `Project.images`."""
        return self.whole("n", 0) - self.owner.first_number

    @image1.setter
    def image1(self, value: int) -> None:
        self.set("n", value + self.owner.first_number)

    @property
    def image2(self) -> int:
        """Index of the second image in `Project.images`."""
        return self.whole("N", 0) - self.owner.first_number

    @image2.setter
    def image2(self, value: int) -> None:
        self.set("N", value + self.owner.first_number)


class Mask(FieldLine):
    """A k-line: a polygon that leaves out, or claims, a part of an image."""

    __slots__ = ()
    keys, head = grammar.MASK, b"k"

    image = Whole("i", 0, "Index of the image in `Project.images`.")
    type = Whole(
        "t", 0, "0 leave out, 1 claim, 2 and 3 the same for the whole stack, 4 leave out for the whole lens."
    )

    def check(self) -> None:
        """Raise `PtoError` where the line names an image that is not there."""
        self.check_image(f"i{self.image}", self.image, 0, self.owner.image_count)

    @property
    def points(self) -> list[tuple[float, float]]:
        """The corners (x, y) in the image's pixels."""
        numbers = [float(item) for item in grammar.split_numbers(self.value("p") or b"")]
        return list(zip(numbers[::2], numbers[1::2], strict=True))

    @points.setter
    def points(self, value: Iterable[tuple[float, float]]) -> None:
        self.set("p", " ".join(self.number_text(number) for point in value for number in point))


class VariableLine(Line):
    """A v-line: image variables that the optimiser may change; one without entries ends the list."""

    __slots__ = ()
    head = b"v"

    @property
    def entries(self) -> list[tuple[str, int | None]]:
        """Variable and image number, as the file counts (see `Project.first_number`).

        The number is None where PTGui names a variable of the whole lens.
        """
        return [self._split(self.raw[start:end]) for start, end in self._spans()]

    @entries.setter
    def entries(self, value: Iterable[tuple[str, int | None]]) -> None:
        before, raw, new = self.raw, self.raw, list(value)
        spans, old = self._spans(), self.entries
        texts = [self.encode(name if number is None else f"{name}{number}") for name, number in new]
        end = spans[-1][1] if spans else len(self.head)
        raw = raw[:end] + b"".join(b" " + text for text in texts[len(old) :]) + raw[end:]
        for index in reversed(range(len(old))):
            start, end = spans[index]
            if index >= len(new):
                raw = raw[:start].rstrip() + raw[end:]
            elif old[index] != new[index]:
                raw = raw[:start] + texts[index] + raw[end:]
        self.replace(raw)
        if self.entries != new:
            self.replace(before)
            raise self.error(b" ".join(texts), "variables, each with an image's number")

    def check(self) -> None:
        """Raise `PtoError` where the line names an image that is not there."""
        end = self.owner.first_number + self.owner.image_count
        for name, number in self.entries:
            if number is not None:
                self.check_image(f"{name}{number}", number, 0, end)

    def read(self) -> None:
        """Raise `PtoError` for an entry that is no variable."""
        for start, end in self._spans():
            self._split(self.raw[start:end])

    def _spans(self) -> list[tuple[int, int]]:
        return list(grammar.tokens(self.raw, len(self.head), self.owner.file, self.number))

    def _split(self, token: bytes) -> tuple[str, int | None]:
        match = grammar.VARIABLE_ENTRY.fullmatch(token)
        if match:
            return match[1].decode(), int(match[2])
        name = token.decode("ascii", "replace")
        if name not in grammar.VARIABLES:
            raise self.error(token, "a variable with an image's number, such as 'y1'")
        return name, None


class HuginLine(FieldLine):
    """A ``#-hugin`` line: what Hugin adds to an image. Fields are ``key=value`` or a word alone."""

    __slots__ = ()
    head = b"#-hugin"

    crop_factor = Number("cropFactor", 1.0, "Crop factor of the camera's sensor.")

    @property
    def disabled(self) -> bool:
        """Whether the image takes no part in the panorama."""
        return self.get("disabled") is not None

    @disabled.setter
    def disabled(self, value: bool) -> None:
        self.set("disabled", "" if value else None)

    def scan(self) -> Iterator[grammar.Field]:
        """The fields and where they lie in `raw`. Raises `PtoError` where a quote is not closed."""
        raw = self.raw
        for start, end in grammar.tokens(raw, len(self.head), self.owner.file, self.number):
            name, equals, _ = raw[start:end].partition(b"=")
            yield grammar.Field(decode(name), start, start + len(name + equals), end)

    def prefix(self, key: str) -> bytes:
        """What is written in front of the value of a new field."""
        return self.encode(key) + (b"" if key == "disabled" else b"=")


class ImageFileLine(FieldLine):
    """PTGui's ``#-imgfile width height "name"``: the fields w, h and n of an image."""

    __slots__ = ()
    head = b"#-imgfile"

    def scan(self) -> Iterator[grammar.Field]:
        """The fields and where they lie in `raw`. Raises `PtoError` for a malformed one."""
        raw = self.raw
        spans = list(grammar.tokens(raw, len(self.head), self.owner.file, self.number))
        if len(spans) != len(_IMAGE_FILE_FIELDS):
            raise self.error(raw.rstrip(), 'width, height and "name"')
        for (key, kind), (start, end) in zip(_IMAGE_FILE_FIELDS, spans, strict=True):
            if not kind.accepts(raw[start:end]):
                raise self.error(raw[start:end], kind.expected)
            yield grammar.Field(key, start, start, end)

    def format(self, key: str, value: str | float) -> bytes:
        """The bytes of a value; only the name stands within quotes."""
        content = super().format("", value)
        return b'"%b"' % content if key == "n" else content


class OptionLine(Line):
    """A ``#hugin_name value`` line."""

    __slots__ = ("_value_start", "name")
    head = b"#hugin_"
    name: str  # without ``#hugin_``
    _value_start: int

    @classmethod
    def matches(cls, raw: bytes) -> bool:
        """Whether a line is an option; ``#hugin_`` without a name is an ordinary comment."""
        return _OPTION.match(raw) is not None

    def read(self) -> None:
        """Take in the name. Raises `PtoError` where there is none."""
        match = _OPTION.match(self.raw)
        if not match:
            raise self.error(self.raw.rstrip(), "'#hugin_' and an option's name")
        self.name, self._value_start = decode(match[1]), match.end()

    @property
    def text(self) -> str:
        """The value, without the blanks around it; empty: the default."""
        return decode(self.raw[self._value_start :].strip())

    @text.setter
    def text(self, value: str) -> None:
        content = self.encode(value)
        if content != content.strip():
            raise self.error(content, "a value without blanks around it")
        old = self.raw[self._value_start :]
        start = self.raw[: self._value_start]
        blank = b"" if start[-1:] in b" \t" or not content else b" "
        self.replace(start + blank + content + old[len(old.rstrip()) :])
