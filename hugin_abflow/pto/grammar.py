"""The keys of each line of a .pto file and what may stand after them.

A line is one letter, then fields parted by blanks; a field is a key with its value attached: ``w512``,
``v=0``, ``n"a name.jpg"``. There are no escapes: a quoted value ends at the next quote. Sources: Hugin's
``nona.txt``, libpano13's ``stitch.txt`` and ``Optimize.txt``, Hugin's ``PTScriptParsing.cpp``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from hugin_abflow.errors import PtoError

# All quantifiers below are arranged so that a long line costs linear time even where it does not match.
_TOKEN = re.compile(rb'[^\s"]+(?:"[^"]*")?|"[^"]*"')
_NAME = re.compile(rb"[A-Za-z_]+")
_INDEX = re.compile(rb"\d{1,9}")
_WHOLE = re.compile(rb"[-+]?\d{1,9}(?:\.0*)?")
_NUMBER = re.compile(rb"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
_BOX = re.compile(rb"[-+]?\d{1,9}(?:,[-+]?\d{1,9}){3}")
_SEPARATOR = re.compile(rb"[\s,]+")

# Longer tokens are cut in error messages; a damaged file can hold megabytes without a blank.
_LONGEST_TOKEN = 200


def show(token: bytes) -> str:
    """A token as text for an error message, cut where it is long."""
    text = token[: _LONGEST_TOKEN + 1].decode("utf-8", "backslashreplace")
    return text if len(token) <= _LONGEST_TOKEN else text[:_LONGEST_TOKEN] + "..."


def is_number(value: bytes) -> bool:
    """A decimal number within the range of a double; the point is always a point."""
    return _NUMBER.fullmatch(value) is not None and math.isfinite(float(value))


def is_link(value: bytes) -> bool:
    """``=N``: the value is that of image N."""
    return value[:1] == b"=" and _INDEX.fullmatch(value, 1) is not None


def is_quoted(value: bytes) -> bool:
    """Text within quotes."""
    return len(value) > 1 and value[:1] == b'"' == value[-1:]


def unquote(value: bytes) -> bytes:
    """The text of a value, without its quotes if it has any."""
    return value[1:-1] if is_quoted(value) else value


def split_numbers(value: bytes) -> list[bytes]:
    """The items of a list of numbers, parted by blanks or commas."""
    return [item for item in _SEPARATOR.split(unquote(value)) if item]


def _is_number_list(value: bytes) -> bool:
    return is_quoted(value) and all(map(is_number, split_numbers(value)))


def _is_point_list(value: bytes) -> bool:
    return _is_number_list(value) and len(split_numbers(value)) % 2 == 0


def _is_text(value: bytes) -> bool:
    return is_quoted(value) or (value != b"" and b'"' not in value)


@dataclass(frozen=True)
class ValueType:
    """A type of value.

    expected    how an error names it.
    accepts     tests a value.
    plain       a pattern for values as Hugin writes them; `accepts` takes these and maybe more.
    quoted      whether it is written within quotes.
    """

    expected: str
    accepts: Callable[[bytes], bool]
    plain: bytes
    quoted: bool = False


# Digits are limited so that every plain number is finite.
_PLAIN_NUMBER = rb"-?\d{1,40}(?:\.\d{1,40})?(?:[eE][-+]?\d{1,2})?"
_PLAIN_TEXT = rb'"[^"]*"'
_NEVER = rb"(?!)"  # no plain form: always tested by `accepts`

INDEX = ValueType("a whole number from 0", lambda value: _INDEX.fullmatch(value) is not None, rb"\d{1,9}")
WHOLE = ValueType("a whole number", lambda value: _WHOLE.fullmatch(value) is not None, rb"-?\d{1,9}")
SIZE = ValueType("a whole number from 1", lambda value: INDEX.accepts(value) and int(value) > 0, _NEVER)
NUMBER = ValueType("a number", is_number, _PLAIN_NUMBER)
POSITIVE = ValueType("a number above 0", lambda value: is_number(value) and float(value) > 0, _NEVER)
LINKABLE = ValueType(
    "a number or '=' and an image's number",
    lambda value: is_number(value) or is_link(value),
    rb"(?:=\d{1,9}|%b)" % _PLAIN_NUMBER,
)
BOX = ValueType(
    "four whole numbers: left,right,top,bottom",
    lambda value: _BOX.fullmatch(value) is not None,
    _BOX.pattern,
)
TEXT = ValueType("a text within quotes", _is_text, _PLAIN_TEXT, quoted=True)
PIXEL_TYPE = ValueType("a pixel type", lambda value: not value or _is_text(value), _PLAIN_TEXT, quoted=True)
NUMBERS = ValueType("numbers within quotes", _is_number_list, _NEVER, quoted=True)
POINTS = ValueType("pairs of numbers within quotes", _is_point_list, _NEVER, quoted=True)
MASK_TYPE = ValueType("a mask type from 0 to 4", lambda value: value in {b"%d" % n for n in range(5)}, _NEVER)
FLAG = ValueType("no value", lambda value: not value, b"")


class Keys:
    """The known keys of one kind of line."""

    def __init__(self, types: Mapping[str, ValueType], required: tuple[str, ...] = ()) -> None:
        self.types = dict(types)
        self.required = required
        self._accepts = {key.encode(): (key, kind.accepts) for key, kind in types.items()}
        longest_first = sorted(self._accepts, key=len, reverse=True)
        self._known = re.compile(b"|".join(longest_first) or _NEVER)
        plain = b"|".join(key + types[key.decode()].plain for key in longest_first) or _NEVER
        # no possessive quantifiers: up to Python 3.11.2 these match what they should not
        self._plain_line = re.compile(rb"(?:\s+(?:%b)(?!\S))*\s*" % plain)
        self._plain_field = re.compile(rb"(%b)(%b|[^\s\"]*)" % (self._known.pattern, _PLAIN_TEXT))

    def read_plain(self, text: bytes, start: int) -> dict[str, bytes] | None:
        """All fields from byte `start` on in one go, if every one is plain; else None.

        Gives what `scan` gives, but much faster: it reads the lines that Hugin writes.
        """
        if self._plain_line.fullmatch(text, start) is None:
            return None
        # Of a field given twice the first counts: the last to be put in.
        return {key.decode(): value for key, value in reversed(self._plain_field.findall(text, start))}

    def split(self, token: bytes, file: str, line: int) -> tuple[str, int]:
        """The key of a token and where its value begins.

        A token with an unknown key is kept as it is. A known key with a value of the wrong type raises
        `PtoError`, except where the letters go on and make an unknown key: ``ve5`` is not ``v``, but
        ``Snan,1,2,3`` is a crop.
        """
        found = self._known.match(token)
        name = _NAME.match(token)
        if found:
            key, accepts = self._accepts[found[0]]
            if accepts(token[found.end() :]):
                return key, found.end()
            rest = token[name.end() :] if name and name.end() > found.end() else b""
            if not rest or (rest.startswith(b",") and self.types[key] is BOX):
                raise PtoError(file, line, show(token), f"{self.types[key].expected} after '{key}'")
        if name:
            return name[0].decode(), name.end()
        return show(token), len(token)


class Field(NamedTuple):
    """A field of a line: its key and where it lies in the line's bytes."""

    key: str
    start: int
    value_start: int
    end: int


def tokens(text: bytes, start: int, file: str, line: int) -> Iterator[tuple[int, int]]:
    """Where the tokens of a line begin and end, from byte `start` on.

    Raises `PtoError` where a quote is not closed on its line.
    """
    if text.count(b'"') % 2:
        raise PtoError(file, line, show(text[text.rindex(b'"') :].rstrip()), 'a closing quote (")')
    for match in _TOKEN.finditer(text, start):
        yield match.span()


def scan(keys: Keys, text: bytes, start: int, file: str, line: int) -> Iterator[Field]:
    """The fields of a line, from byte `start` on. Raises `PtoError` for a malformed one."""
    for token_start, end in tokens(text, start, file, line):
        key, length = keys.split(text[token_start:end], file, line)
        yield Field(key, token_start, token_start + length, end)


def is_line(text: bytes, letter: bytes) -> bool:
    """Whether a line is of the kind `letter`: nothing or a blank follows it."""
    return text[:1] == letter and (text[1:2] in b" \t\r\n\v\f")


VARIABLES = (
    *("v", "Ra", "Rb", "Rc", "Rd", "Re", "Eev", "Er", "Eb", "r", "p", "y"),
    *("TrX", "TrY", "TrZ", "Tpy", "Tpp", "j", "a", "b", "c", "d", "e", "g", "t"),
    *("Va", "Vb", "Vc", "Vd", "Vx", "Vy"),
    *("TiX", "TiY", "TiZ", "TiS", "Te0", "Te1", "Te2", "Te3"),  # libpano13 only
    *("K0a", "K0b", "K1a", "K1b", "K2a", "K2b"),  # Hugin before 0.7
)

# What an absent variable is worth; all others are 0 (Hugin's image_variables.h).
VARIABLE_DEFAULTS = {"v": 50.0, **dict.fromkeys(("Er", "Eb", "Va", "TiS", "K0a", "K1a", "K2a"), 1.0)}

PANORAMA = Keys(
    {
        **{"f": INDEX, "w": SIZE, "h": SIZE, "v": POSITIVE, "E": NUMBER, "R": WHOLE, "T": PIXEL_TYPE},
        **{"S": BOX, "C": BOX, "P": NUMBERS, "n": TEXT, "k": WHOLE, "b": NUMBER, "d": NUMBER},
        **{"u": NUMBER, "a": NUMBER, "c": NUMBER},
    }
)
MODES = Keys({"i": INDEX, "g": NUMBER, "f": WHOLE, "m": NUMBER, "p": NUMBER, "s": NUMBER})
IMAGE = Keys(
    {
        **dict.fromkeys(VARIABLES, LINKABLE),
        **{"w": INDEX, "h": INDEX, "f": INDEX, "n": TEXT, "S": BOX, "C": BOX},
        **{"Vm": INDEX, "Vf": TEXT, "Rt": WHOLE, "u": NUMBER, "m": NUMBER, "mx": NUMBER, "my": NUMBER},
        **{"s": WHOLE, "o": FLAG},
    }
)
CONTROL_POINT = Keys(
    {"n": INDEX, "N": INDEX, "x": NUMBER, "y": NUMBER, "X": NUMBER, "Y": NUMBER, "t": INDEX},
    required=("n", "N", "x", "y", "X", "Y"),
)
MASK = Keys({"i": INDEX, "t": MASK_TYPE, "p": POINTS}, required=("i", "p"))

# A control point as Hugin writes it, with the numbers of its images.
PLAIN_CONTROL_POINT = re.compile(
    rb"c n(\d{1,9}) N(\d{1,9}) x%b y%b X%b Y%b t\d{1,9}\s*" % ((_PLAIN_NUMBER,) * 4)
)
VARIABLE_ENTRY = re.compile(b"(%b|[A-Za-z]+)(\\d{1,9})" % "|".join(sorted(VARIABLES, key=len)[::-1]).encode())
