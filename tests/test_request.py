"""What enblend's options mean."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hugin_abflow.dropin.request import HELP, OPTIONS, Request, read_command_line
from hugin_abflow.errors import CommandLineError
from hugin_abflow.layer import Box

PLAIN = Request(inputs=(Path("a.tif"),))


def request(line: str) -> Request:
    return read_command_line(["a.tif", *line.split()])


DIGITS = "9" * 5000  # more than Python makes a number of


@pytest.mark.parametrize(
    ("line", "changed"),
    [
        ("", {}),
        ("-o x.tif", {"output": Path("x.tif")}),
        ("-o x.tif -o y.tif", {"output": Path("y.tif")}),
        ("-f200x100", {"crop": Box(0, 0, 200, 100)}),
        ("-f 200x100+7+20", {"crop": Box(7, 20, 207, 120)}),
        ("-f 200x100+x7+y20", {"crop": Box(7, 20, 207, 120)}),
        ("-w", {"wraps": True}),
        ("-wHorizontal", {"wraps": True}),
        ("--wrap=NONE", {}),
        ("-w --wrap=none", {}),
        ("-w --wrap=Open", {}),
        ("-d 8", {"depth": np.uint8}),
        ("--depth=16", {"depth": np.uint16}),
        ("-dR32", {"depth": np.float32}),
        ("-dr64", {"depth": np.float64}),
        ("--compression=LZW", {"compression": "lzw"}),
        ("--compression None", {"compression": "none"}),
        ("--compression=92", {"compression": "jpeg", "jpeg_quality": 92}),
        ("--compression=0", {"compression": "jpeg", "jpeg_quality": 1}),
        ("--compression=101", {"compression": "jpeg", "jpeg_quality": 100}),
        ("--compression=JPEG:80", {"compression": "jpeg", "jpeg_quality": 80}),
        ("--compression=jpeg", {"compression": "jpeg"}),
        ("-v", {"verbosity": 2}),
        ("-v -v", {"verbosity": 3}),
        ("-v0", {"verbosity": 0}),
        ("--verbose=3 -v", {"verbosity": 4}),
        ("--verbose=-1", {"verbosity": 0}),
        ("-l auto -a --no-pre-assemble --layer-selector=ALL-layers", {}),
        ("--save-masks", {"save_masks": "mask-%n.tif"}),
        ("--save-masks=%f-m.tif", {"save_masks": "%f-m.tif"}),
        ("--load-masks", {"load_masks": "mask-%n.tif"}),
        ("--parameter=abflow-project=C:\\a=b:c.pto", {"project": Path("C:\\a=b:c.pto")}),
        ("-l 29", {"ignored": ("--levels",)}),
        ("-l -2", {"ignored": ("--levels",)}),
        ("--layer-selector=first-layer", {"ignored": ("--layer-selector",)}),
        ("--parameter=x=1:y", {"ignored": ("--parameter",)}),
        ("--parameter=x:abflow-project=p", {"project": Path("p"), "ignored": ("--parameter",)}),
        ("-c --anneal=0.5 --fine-mask", {"ignored": ("--ciecam", "--anneal", "--fine-mask")}),
        ("-b 4096 -m 1024 -s -z -x -g", {"ignored": ("-b", "-m", "-s", "-z", "-x", "-g")}),
        ("--coarse-mask=4 --coarse-mask", {"ignored": ("--coarse-mask", "--coarse-mask")}),
    ],
)
def test_option_means(line: str, changed: dict[str, Any]) -> None:
    assert request(line) == replace(PLAIN, **changed)


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("--output=", "--output needs the name"),
        ("-f 200", "-f 200: give WIDTHxHEIGHT"),
        ("-f200x100+3", "give WIDTHxHEIGHT"),
        ("-f200x100+y3+x4", "give WIDTHxHEIGHT"),
        ("-f200x100-3+4", "give WIDTHxHEIGHT"),
        ("-f0x100", "give WIDTHxHEIGHT"),
        ("-wvertical", "--wrap=vertical is not possible"),
        ("--wrap=Both", "--wrap=both is not possible"),
        ("--wrap=vertical+horizontal", "--wrap=vertical+horizontal is not possible"),
        ("-wsideways", "choose none or horizontal"),
        ("-d 64", "--depth=64 is not possible; choose 8, 16, r32 or r64"),
        ("--compression=zip", "choose none, packbits, lzw, deflate, zstd, jpeg, or 0 to 100"),
        ("--compression=-5", "or 0 to 100"),
        ("--compression=lzw:3", "or 0 to 100"),
        ("--compression=jpeg:best", "or 0 to 100"),
        (f"--compression={DIGITS}", "or 0 to 100"),
        (f"--compression=jpeg:{DIGITS}", "or 0 to 100"),
        (f"-f {DIGITS}x{DIGITS}", "give WIDTHxHEIGHT"),
        (f"-v{DIGITS}", "choose a whole number"),
        ("-l x", "choose a whole number or auto"),
        ("-vx", "--verbose=x: choose a whole number"),
        ("-va", "--verbose=a"),
        ("--parameter=abflow-project=", "name the project"),
        ("--fine-mask=3", "--fine-mask takes no value"),
        ("--bogus", "unknown option --bogus"),
    ],
)
def test_option_is_refused(line: str, part: str) -> None:
    with pytest.raises(CommandLineError, match=re.escape(part)):
        request(line)


@pytest.mark.parametrize("line", ["--save-masks --load-masks", "--load-masks=m%n.tif --save-masks=s%n.tif"])
def test_masks_are_saved_or_loaded(enblend: str, line: str) -> None:
    """Not both, as of enblend: under one name, what somebody painted would be lost."""
    theirs = subprocess.run([enblend, "a.tif", *line.split()], capture_output=True, text=True)
    assert theirs.returncode == 1 and "mutually exclusive" in theirs.stderr
    with pytest.raises(CommandLineError, match="--save-masks and --load-masks exclude each other"):
        request(line)


def test_inputs_are_needed_but_for_an_answer() -> None:
    with pytest.raises(CommandLineError, match="no input files"):
        read_command_line(["-o", "x.tif"])
    assert read_command_line(["-h"]).answer == "help"
    for option in ("-V", "--version", "--show-image-formats", "--show-signature"):
        assert read_command_line([option]).answer == "version"
    with pytest.raises(CommandLineError, match="bogus"):
        read_command_line(["--version", "--bogus"])


def test_every_option_of_enblend_is_known(enblend: str) -> None:
    """Those that its help lists, each with the kind of value that the list shows."""
    shown = subprocess.run([enblend, "--help"], capture_output=True, text=True, check=True).stdout
    rows = re.findall(r"^  (?:(-\w), )?(--[\w-]+|-\w)(\[?[= ]?)", shown, re.MULTILINE)
    assert len(rows) > 30
    kinds = {"=": "required", "[=": "optional"}
    known = {name: option.value for option in OPTIONS for name in option.names}
    for short, long, value in rows:
        assert known[long] == ("required" if long == "-f" else kinds.get(value, "none")), long
        assert not short or known[short] == known[long]
    assert set(re.findall(r'"(--no-[\w-]+)"', shown)) <= set(known)


def test_options_take_a_value_where_enblend_takes_one(enblend: str) -> None:
    """Also those that its help does not list: what follows them is a value, or a file."""
    for option in OPTIONS:
        for name in option.names:
            done = subprocess.run([enblend, "gone.tif", name], capture_output=True, text=True)
            needed = f'option "{name}" requires an argument' in done.stderr
            assert needed == (option.value == "required"), name


def test_help_lists_what_has_a_meaning() -> None:
    """And none of the options that change nothing, whatever their value."""
    listed = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", HELP))
    without_value = [option for option in OPTIONS if option.value != "required"]
    ignored = {name for option in without_value for name in option.names if request(name).ignored}
    assert len(ignored) > 10 and not listed & ignored
    assert listed <= {name for option in OPTIONS for name in option.names}
