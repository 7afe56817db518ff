"""GNU getopt's rules, one by one, and response files."""

from __future__ import annotations

from pathlib import Path

import pytest

from hugin_abflow.dropin.arguments import Option, expand, parse
from hugin_abflow.errors import CommandLineError, LayersMissingError

OUTPUT = Option(("-o", "--output"), "required")
WRAP = Option(("-w", "--wrap"), "optional")
ASSEMBLE = Option(("-a", "--assemble"))
LOAD = Option(("--load-masks",), "optional")
LEVELS = Option(("-l", "--levels"), "required")
NEGATIVE = Option(("--no-assemble",))
NEGATIVE_GPU = Option(("--no-gpu",))
ALL = [OUTPUT, WRAP, ASSEMBLE, LOAD, LEVELS, NEGATIVE, NEGATIVE_GPU]


@pytest.mark.parametrize(
    ("line", "given", "files"),
    [
        # values: attached or not, and attached only where they may be missing
        ("-o x a", [(OUTPUT, "x")], "a"),
        ("-ox a", [(OUTPUT, "x")], "a"),
        ("--output x a", [(OUTPUT, "x")], "a"),
        ("--output=x a", [(OUTPUT, "x")], "a"),
        ("--output=x=y a", [(OUTPUT, "x=y")], "a"),
        ("-o -w a", [(OUTPUT, "-w")], "a"),
        ("-l -2 a", [(LEVELS, "-2")], "a"),
        ("--output= a", [(OUTPUT, "")], "a"),
        ("-w both", [(WRAP, None)], "both"),
        ("-wboth", [(WRAP, "both")], ""),
        ("--wrap both", [(WRAP, None)], "both"),
        ("--wrap=both", [(WRAP, "both")], ""),
        # letters together
        ("-aw a", [(ASSEMBLE, None), (WRAP, None)], "a"),
        ("-awa", [(ASSEMBLE, None), (WRAP, "a")], ""),
        ("-aox a", [(ASSEMBLE, None), (OUTPUT, "x")], "a"),
        ("-ao x a", [(ASSEMBLE, None), (OUTPUT, "x")], "a"),
        # long names shortened
        ("--out x", [(OUTPUT, "x")], ""),
        ("--o=x", [(OUTPUT, "x")], ""),
        ("--no-a", [(NEGATIVE, None)], ""),
        # order, and where options end
        ("a -o x b -a", [(OUTPUT, "x"), (ASSEMBLE, None)], "a b"),
        ("-o x -o y", [(OUTPUT, "x"), (OUTPUT, "y")], ""),
        ("-a -- -w --wrap", [(ASSEMBLE, None)], "-w --wrap"),
        ("a - b", [], "a - b"),
        ("a -- -- b", [], "a -- b"),
    ],
)
def test_line_is_understood(line: str, given: list[tuple[Option, str | None]], files: str) -> None:
    assert parse(line.split(), ALL) == (given, files.split())


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("--bogus", "unknown option --bogus"),
        ("--output-x=3", "unknown option --output-x"),
        ("-q", "unknown option -q"),
        ("-aq", "unknown option -q"),
        ("--no", "--no may mean any of --no-assemble, --no-gpu"),
        ("--l", "--load-masks, --levels"),
        ("-o", "-o needs a value"),
        ("a --output", "--output needs a value"),
        ("--assemble=1", "--assemble takes no value"),
    ],
)
def test_line_is_refused(line: str, part: str) -> None:
    with pytest.raises(CommandLineError, match=part):
        parse(line.split(), ALL)


def test_whole_name_is_not_ambiguous() -> None:
    longer = Option(("--assemble-all",))
    assert parse(["--assemble"], [longer, ASSEMBLE]) == ([(ASSEMBLE, None)], [])


def test_response_files_nest_and_are_relative_to_themselves(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "all.txt").write_text("# layers\na b.tif\n\n  é.tif  \r\n@sub/more.txt\n/x/z.tif", "utf-8")
    (tmp_path / "sub" / "more.txt").write_text("../c.tif\n#d.tif\ne#f.tif\n")
    files, lists = expand(["0.tif", f"@{tmp_path}/all.txt", "1.tif"])
    assert files == [
        Path("0.tif"),
        tmp_path / "a b.tif",
        tmp_path / "é.tif",
        tmp_path / "sub" / ".." / "c.tif",
        tmp_path / "sub" / "e#f.tif",
        Path("/x/z.tif"),
        Path("1.tif"),
    ]
    assert lists == [tmp_path / "all.txt", tmp_path / "sub" / "more.txt"]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("l*.tif", "l*.tif"),
        ("#glob: wildcard\nl*.tif", "l0.tif l1.tif"),
        ("#  Globbing : WILDCARD \nl[1-9].tif\n#filename-globbing:literal\nl*.tif", "l1.tif l*.tif"),
        ("l?.tif\n#glob: wildcard", "l?.tif"),
        ("#glob: none\nl0.tif", "l0.tif"),
        ("#glob: shell\n{l1,b/[a-d],l0}.tif", "l1.tif b/c.tif l0.tif"),
        ("#glob: sh\n~/l{0,{1,0}}.tif", "{here}/l0.tif {here}/l1.tif"),
        ("#glob: wildcard\n@b/list", "b/c.tif b/ä.tif"),
        ("# x glob: wildcard\n##glob: wildcard\n#glob wildcard\n#glob:\nl*.tif", "l*.tif"),
        ("#glob: wildcard\n{here}/l1*", "{here}/l1.tif"),
    ],
)
def test_response_files_may_hold_patterns_as_enblends_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lines: str, expected: str
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "b").mkdir()
    for name in ("l1.tif", "l0.tif", ".l2.tif", "b/c.tif", "b/ä.tif"):
        (tmp_path / name).touch()
    (tmp_path / "b" / "list").write_text("*.tif\n")
    (tmp_path / "list").write_text(lines.replace("{here}", str(tmp_path)))
    files = [tmp_path / name.replace("{here}", str(tmp_path)) for name in expected.split()]
    assert expand([f"@{tmp_path / 'list'}"])[0] == files


def test_patterns_of_response_files_that_cannot_be(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "a").write_text("#glob: wild cards\nl*.tif\n#glob: wildcard\n\nl*.tif\n")
    with pytest.raises(LayersMissingError, match=r"a, line 5: no file fits l\*\.tif; correct the list"):
        expand([f"@{tmp_path / 'a'}"])
    assert "a, line 1: 'wild cards' is none of literal, none, wildcard, shell, sh" in caplog.text


def test_response_file_that_names_itself_is_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.txt").write_text("@b.txt\na.tif\n")
    (tmp_path / "b.txt").write_text("b.tif\n@a.txt\n")
    assert expand([f"@{tmp_path / 'a.txt'}"])[0] == [tmp_path / "b.tif", tmp_path / "a.tif"]
    assert "a.txt names itself" in caplog.text
    # twice is not within itself
    assert len(expand([f"@{tmp_path / 'a.txt'}"] * 2)[0]) == 4


def test_names_that_are_empty(tmp_path: Path) -> None:
    """They would be the current folder."""
    with pytest.raises(CommandLineError, match="'' among the arguments names no file; name a layer"):
        expand(["a.tif", ""])
    with pytest.raises(CommandLineError, match="'@' among the arguments names no file; name a list"):
        expand(["@"])
    (tmp_path / "a.txt").write_text("a.tif\n@\n")
    with pytest.raises(LayersMissingError, match=r"a\.txt, line 2: @ names no list; correct the list"):
        expand([f"@{tmp_path / 'a.txt'}"])


def test_response_file_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(LayersMissingError, match=r"gone\.txt cannot be read: No such file"):
        expand([f"@{tmp_path / 'gone.txt'}"])
