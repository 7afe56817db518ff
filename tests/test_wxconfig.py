"""wxWidgets' files of settings, edited without a byte too many."""

from __future__ import annotations

import pytest

from hugin_abflow.dropin.wxconfig import changed, quoted, stored

CONFIG = """Language=0
[Enblend]
Args=--fine-mask
 custom = 0
[Enfuse]
Custom=0
[/Enblend]
Custom=9
"""


@pytest.mark.parametrize(
    ("content", "value"),
    [
        ("", None),
        ("Custom=1\n", None),
        ("[Enblend]\nCustom=1", "1"),
        ("[enblend]\r\nCUSTOM = a b \r\n", "a b"),
        ("[Enblend]\n!Custom=1\n", "1"),
        ("[Enblend]\n[Enfuse]\nCustom=1\n", None),
        ("[Enblend]\nCustom=1\n[X]\n[Enblend]\nCustom=2\n", "2"),
        ("[Enblend]\n#Custom=1\nCustomer=2\n", None),
        ("[Enblend]\nCustom=a=[b]\n", "a=[b]"),
        (CONFIG, "0"),
    ],
)
def test_value_that_counts(content: str, value: str | None) -> None:
    assert stored(content, "Enblend", "Custom") == value


@pytest.mark.parametrize(
    ("content", "values", "expected"),
    [
        ("", {"Custom": "1"}, "[Enblend]\nCustom=1\n"),
        ("A=1", {"Custom": "1"}, "A=1\n[Enblend]\nCustom=1\n"),
        ("A=1\r\n", {"Custom": "1"}, "A=1\r\n[Enblend]\r\nCustom=1\r\n"),
        ("[Enblend]", {"Custom": "1"}, "[Enblend]\nCustom=1\n"),
        ("[Enblend]\nA=1\n", {"Custom": "1", "Exe": "e"}, "[Enblend]\nCustom=1\nExe=e\nA=1\n"),
        ("[Enblend]\nCustom=0\nA=1\n", {"Custom": "1"}, "[Enblend]\nCustom=1\nA=1\n"),
        ("[Enblend]\nCustom=0\nA=1\n", {"Custom": None, "Exe": None}, "[Enblend]\nA=1\n"),
        ("[Enblend]\n[X]\n[enblend]\nB=1\n", {"Custom": "1"}, "[Enblend]\nCustom=1\n[X]\n[enblend]\nB=1\n"),
        ("[Enblend]\nCustom=0\nCustom=2\n", {"Custom": "1"}, "[Enblend]\nCustom=1\nCustom=1\n"),
        ("[X]\nCustom=0\x85\x0b\n", {"Custom": None}, "[X]\nCustom=0\x85\x0b\n"),
        (CONFIG, {"Custom": "1"}, CONFIG.replace(" custom = 0", "Custom=1")),
    ],
)
def test_keys_are_changed_and_nothing_else(
    content: str, values: dict[str, str | None], expected: str
) -> None:
    assert changed(content, "Enblend", values) == expected
    for key, value in values.items():
        assert stored(expected, "Enblend", key) == value


def test_characters_that_wxwidgets_would_take_apart() -> None:
    assert quoted("/a b/'é\"%x%") == "/a b/'é\"%x%"
    assert quoted("C:\\a\\$b") == r"C:\\a\\\\$b"
