"""Names and other people's texts where a line must not end: in comments of scripts, in messages."""

from __future__ import annotations

import re

# ASCII's and ISO 8859's, and Unicode's two ends of lines.
_CONTROL = re.compile("[\0-\x1f\x7f-\x9f\u2028\u2029]")


def one_line(text: str) -> str:
    """A text without control characters, for each of which there is a question mark."""
    return _CONTROL.sub("?", text)


def commented(text: str) -> str:
    """A comment of a shell script or of TOML. After a line break in a name, a shell runs what follows."""
    return f"# {one_line(text)}"
