"""What all lines of a .pto file share: their bytes, their fields, and how one field is changed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Protocol, Self, overload

from hugin_abflow.errors import PtoError
from hugin_abflow.pto import grammar

Box = tuple[int, int, int, int]
_NO_KEYS = grammar.Keys({})


class Owner(Protocol):
    """What a line needs to know of the project that it stands in."""

    @property
    def file(self) -> str:
        """Name of the project file, for messages."""

    @property
    def first_number(self) -> int:
        """What the file calls the first image: 0, or 1 where PTGui counts its dummy image."""

    @property
    def image_count(self) -> int:
        """Number of images."""

    @property
    def newline(self) -> bytes:
        """The file's line end."""


class Line:
    """A line with a meaning.

    owner       the project.
    number      the line's number in the file, from 1; 0 for a line that the file lacks.
    raw         the line's bytes, its line end included; empty as long as a line that the file lacks
                has no field.
    """

    __slots__ = ("number", "owner", "raw")
    head: ClassVar[bytes] = b""  # what the line begins with

    def __init__(self, owner: Owner, number: int, raw: bytes) -> None:
        self.owner, self.number, self.raw = owner, number, raw
        self.read()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} line {self.number}: {grammar.show(self.raw.rstrip())}>"

    def read(self) -> None:
        """Take in `raw`. Raises `PtoError` where it is malformed."""

    def check(self) -> None:
        """Raise `PtoError` where the line names an image that is not there."""

    def error(self, token: bytes | str, expected: str) -> PtoError:
        """The error for a token of this line."""
        text = token if isinstance(token, str) else grammar.show(token)
        return PtoError(self.owner.file, self.number, text, expected)

    def encode(self, text: str) -> bytes:
        """Text as it stands in the file; the inverse of `decode`."""
        try:
            return text.encode("utf-8", "surrogateescape")
        except UnicodeEncodeError:
            raise self.error(ascii(text), "text that UTF-8 can hold") from None

    def number_text(self, value: float) -> str:
        """The shortest text that reads back as the same double; whole numbers without a point."""
        try:
            whole = float(value).is_integer() and abs(value) < 1e15
        except OverflowError:
            raise self.error("a number of many digits", "one within the range of a double") from None
        return str(int(value)) if whole else repr(float(value))

    def replace(self, raw: bytes) -> None:
        """Take over new bytes if they are one well-formed line; else leave everything as it was."""
        if len(raw.splitlines()) > 1 or b"\0" in raw:
            raise self.error(raw.rstrip(), "a value without line breaks and NUL bytes")
        before = self.raw
        try:
            self.raw = raw
            self.read()
            self.check()
        except PtoError:
            self.raw = before
            self.read()
            raise

    def check_image(self, token: str, image: int, first: int, end: int) -> None:
        """Raise `PtoError` for `token` unless the image number in it is one from `first` to before `end`."""
        if not first <= image < end:
            numbers = f"an image's number from {first} to {end - 1}" if end > first else "no image's number"
            raise self.error(token, f"{numbers} (the file has {self.owner.image_count} images)")


class FieldLine(Line):
    """A line of fields: `get`, `set`, `number_of` and `whole` reach each by its key, known or not."""

    __slots__ = ("_values",)
    keys: ClassVar[grammar.Keys] = _NO_KEYS
    _values: dict[str, bytes]

    def read(self) -> None:
        """Take in the fields. Of a field given twice the first counts, as in Hugin."""
        raw = self.raw
        values = self.keys.read_plain(raw, len(self.head))
        if values is None:
            values = {}
            for key, _, start, end in self.scan():
                values.setdefault(key, raw[start:end])
        for key in self.keys.required:
            if key not in values:
                raise self.error(raw.rstrip(), f"a field '{key}'")
        self._values = values

    def scan(self) -> Iterator[grammar.Field]:
        """The fields and where they lie in `raw`. Raises `PtoError` for a malformed one."""
        return grammar.scan(self.keys, self.raw, len(self.head), self.owner.file, self.number)

    def get(self, key: str) -> str | None:
        """The value of a field as text, without quotes; None where the line has no such field.

        Bytes that are no UTF-8 become surrogates (``surrogateescape``).
        """
        value = self._values.get(key)
        return None if value is None else decode(grammar.unquote(value))

    def value(self, key: str) -> bytes | None:
        """The bytes of a field's value as they stand in the file, quotes included."""
        return self._values.get(key)

    def number_of(self, key: str, default: float) -> float:
        """A field as a number. Raises `PtoError` where it holds something else."""
        value = self._values.get(key)
        if value is None:
            return default
        if not grammar.is_number(value):
            raise self.error(value, f"a number after '{key}'")
        return float(value)

    def whole(self, key: str, default: int) -> int:
        """A field as a whole number, a fraction cut off. Raises `PtoError` where it holds something else."""
        return int(self.number_of(key, default))

    def box(self, key: str) -> Box | None:
        """A field ``left,right,top,bottom`` as (left, top, right, bottom); right and bottom exclusive.

        Raises `PtoError` where it holds something else.
        """
        value = self._values.get(key)
        if value is None:
            return None
        if not grammar.BOX.accepts(value):
            raise self.error(value, f"{grammar.BOX.expected} after '{key}'")
        left, right, top, bottom = (int(item) for item in value.split(b","))
        return left, top, right, bottom

    def set(self, key: str, value: str | float | None) -> None:
        """Give a field a value; None removes it. All other bytes of the line stay.

        A new field is put at the line's end. Raises `PtoError`, and changes nothing, for a value that
        could not be read again.
        """
        fields = [field for field in self.scan() if field.key == key]
        raw = self.raw
        if value is None:
            for field in reversed(fields):
                rest = raw[field.end :]
                blank = b" " if rest[:1].strip() else b""  # fields may touch: n"name"w512
                raw = raw[: field.start].rstrip() + blank + rest
            self.replace(raw)
            return
        content = self.format(key, value)
        if fields:
            raw = raw[: fields[0].value_start] + content + raw[fields[0].end :]
        else:
            text = raw.rstrip() or self.head
            raw = text + b" " + self.prefix(key) + content + (raw[len(text) :] if raw else self.owner.newline)
        before = self.raw
        self.replace(raw)
        if self._values.get(key) != content:  # a blank or a quote in the value, or a key that goes on in it
            self.replace(before)
            raise self.error(self.prefix(key) + content, f"one field with the key '{key}'")

    def set_box(self, key: str, box: Box | None) -> None:
        """Set a field from (left, top, right, bottom); None removes it."""
        if box is None:
            self.set(key, None)
        else:
            left, top, right, bottom = box
            self.set(key, f"{left},{right},{top},{bottom}")

    def prefix(self, key: str) -> bytes:
        """What is written in front of the value of a new field."""
        return self.encode(key)

    def format(self, key: str, value: str | float) -> bytes:
        """The bytes of a value, within quotes where the field has them."""
        content = self.encode(value if isinstance(value, str) else self.number_text(value))
        kind = self.keys.types.get(key)
        quoted = kind.quoted if kind else grammar.is_quoted(self._values.get(key, b""))
        return b'"%b"' % content if quoted else content


def decode(text: bytes) -> str:
    """Text of the file; bytes that are no UTF-8 become surrogates, so that nothing is lost."""
    return text.decode("utf-8", "surrogateescape")


class Fields(Protocol):
    """What the properties below are properties of: whatever reaches fields by their keys."""

    def get(self, key: str) -> str | None:
        """The value of a field as text."""

    def set(self, key: str, value: str | float | None) -> None:
        """Give a field a value."""

    def number_of(self, key: str, default: float) -> float:
        """A field as a number."""

    def whole(self, key: str, default: int) -> int:
        """A field as a whole number."""


class Number:
    """A property of a line: the field `key` as a number."""

    def __init__(self, key: str, default: float, doc: str) -> None:
        self.key, self.default, self.__doc__ = key, default, doc

    @overload
    def __get__(self, line: None, owner: type) -> Self: ...
    @overload
    def __get__(self, line: Fields, owner: type) -> float: ...
    def __get__(self, line: Fields | None, owner: type) -> Self | float:
        return self if line is None else line.number_of(self.key, self.default)

    def __set__(self, line: Fields, value: float) -> None:
        line.set(self.key, value)


class Whole:
    """A property of a line: the field `key` as a whole number."""

    def __init__(self, key: str, default: int, doc: str) -> None:
        self.key, self.default, self.__doc__ = key, default, doc

    @overload
    def __get__(self, line: None, owner: type) -> Self: ...
    @overload
    def __get__(self, line: Fields, owner: type) -> int: ...
    def __get__(self, line: Fields | None, owner: type) -> Self | int:
        return self if line is None else line.whole(self.key, self.default)

    def __set__(self, line: Fields, value: int) -> None:
        line.set(self.key, value)


class Text:
    """A property of a line: the field `key` as text."""

    def __init__(self, key: str, default: str, doc: str) -> None:
        self.key, self.default, self.__doc__ = key, default, doc

    @overload
    def __get__(self, line: None, owner: type) -> Self: ...
    @overload
    def __get__(self, line: Fields, owner: type) -> str: ...
    def __get__(self, line: Fields | None, owner: type) -> Self | str:
        if line is None:
            return self
        text = line.get(self.key)
        return self.default if text is None else text

    def __set__(self, line: Fields, value: str) -> None:
        line.set(self.key, value)
