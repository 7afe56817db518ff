"""Files of settings as wxWidgets has them: ``[Group]`` and ``key=value``, edited and else left as they are.

Names ignore case, space around them counts nothing, a group may come more than once, and of a key that does
the last one counts. Seen with hugin_executor 2022.0.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

_KEY = re.compile(r"\s*!?([^=]*?)\s*=\s*(.*?)\s*")


def quoted(text: str) -> str:
    """A value that reads as `text`: wxWidgets expands ``$NAME`` and takes backslashes for escapes."""
    return text.replace("\\", "\\\\").replace("$", "\\\\$")


def stored(content: str, group: str, key: str) -> str | None:
    """The value of a key as it stands there, see `quoted`; None: it does not."""
    found = None
    for its_group, line in _lines(content):
        entry = _KEY.fullmatch(line)
        if entry and _same(its_group, group) and _same(entry[1], key):
            found = entry[2]
    return found


def changed(content: str, group: str, values: Mapping[str, str | None]) -> str:
    """The file with keys of a group set to what is to stand there, or removed (None); all else as it was."""
    end = "\r\n" if "\r\n" in content else "\n"
    result: list[str] = []
    missing = {key: value for key, value in values.items() if stored(content, group, key) is None}
    new = "".join(f"{key}={value}{end}" for key, value in missing.items() if value is not None)
    for its_group, line in _lines(content):
        entry = _KEY.fullmatch(line)
        key = next((key for key in values if entry and _same(entry[1], key)), None)
        if not entry and _is_header(line) and _same(its_group, group):
            line, new = line.rstrip("\r\n") + end + new, ""
        elif key is not None and _same(its_group, group):
            value = values[key]
            line = "" if value is None else f"{key}={value}{end}"
        result.append(line)
    if new:
        gap = "" if not content or content.endswith("\n") else end
        result.append(f"{gap}[{group}]{end}{new}")
    return "".join(result)


def _lines(content: str) -> Iterator[tuple[str, str]]:
    """Each line, its end included, and the group that it is in."""
    group = ""
    for line in re.findall(r"[^\n]*\n|[^\n]+", content):
        if _is_header(line):
            group = line.strip()[1:-1]
        yield group, line


def _is_header(line: str) -> bool:
    return line.strip().startswith("[") and line.strip().endswith("]")


def _same(one: str, other: str) -> bool:
    return one.casefold() == other.casefold()
