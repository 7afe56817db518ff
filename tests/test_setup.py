"""hugin-abflow-setup: preferences and sequences put in place, and taken away again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest

from hugin_abflow.dropin import setup
from hugin_abflow.dropin.places import Places, places
from hugin_abflow.errors import SetupError

CONFIG = b"Language=0\n[Enblend]\nArgs=--fine-mask \xff\nCustom=0\n\n[Enfuse]\nCustom=0\n"
NAMES = {"abflow_panorama.executor", "abflow_layers.executor", "abflow_stacks.executor"}


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the installed programs, of which hugin-abflow-setup is the one that runs."""
    folder = tmp_path / "my programs"
    folder.mkdir()
    for name in ("hugin-abflow", "abflow-enblend", "hugin-abflow-setup"):
        (folder / name).write_text("#!/bin/sh\n")
        (folder / name).chmod(0o755)
    monkeypatch.setattr(sys, "argv", [str(folder / "hugin-abflow-setup")])
    return folder


@pytest.fixture
def hugin(tmp_path: Path, programs: Path) -> Places:
    """Hugin's places, nothing in them yet."""
    return Places(tmp_path / "config" / "hugin.conf", tmp_path / "data" / "hugin", True)


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.skipif(os.name == "nt", reason="Windows has no modes of files")
def test_the_backup_is_as_private_as_the_preferences(hugin: Places) -> None:
    preferences = Path(hugin.preferences)
    preferences.parent.mkdir()
    preferences.write_bytes(CONFIG)
    preferences.chmod(0o600)
    setup.install(hugin)
    backup = preferences.with_name(f"{preferences.name}.before-abflow")
    assert [path.stat().st_mode & 0o777 for path in (preferences, backup)] == [0o600, 0o600]


@pytest.mark.parametrize("content", [None, b"", CONFIG, CONFIG.replace(b"\n", b"\r\n"), b"A=1"])
def test_uninstall_restores_every_byte(hugin: Places, tmp_path: Path, content: bytes | None) -> None:
    preferences = Path(hugin.preferences)
    if content is not None:
        preferences.parent.mkdir()
        preferences.write_bytes(content)
    before = files(tmp_path)
    setup.install(hugin)
    installed = files(tmp_path)
    setup.install(hugin)  # a second time is not one too many
    assert files(tmp_path) == installed != before
    setup.uninstall(hugin)
    assert files(tmp_path) == before


def test_preferences_name_the_program_and_keep_the_rest(hugin: Places, programs: Path) -> None:
    preferences = Path(hugin.preferences)
    preferences.parent.mkdir()
    preferences.write_bytes(CONFIG)
    setup.install(hugin)
    expected = CONFIG.replace(b"Custom=0\n\n", b"Custom=1\n\n")
    exe = b"Exe=" + str(programs / "abflow-enblend").encode() + b"\n"
    assert preferences.read_bytes() == expected.replace(b"[Enblend]\n", b"[Enblend]\n" + exe)
    assert preferences.with_name("hugin.conf.before-abflow").read_bytes() == CONFIG


def test_what_hugin_changed_since_is_kept(hugin: Places) -> None:
    preferences = Path(hugin.preferences)
    preferences.parent.mkdir()
    preferences.write_bytes(CONFIG)
    setup.install(hugin)
    preferences.write_bytes(preferences.read_bytes() + b"New=1\n")
    setup.uninstall(hugin)
    assert preferences.read_bytes() == CONFIG + b"New=1\n"


def test_another_blender_that_was_chosen_since_is_kept(hugin: Places) -> None:
    setup.install(hugin)
    preferences = Path(hugin.preferences)
    preferences.write_bytes(b"[Enblend]\nCustom=1\nExe=/opt/multiblend\n")
    said = setup.uninstall(hugin)
    assert preferences.read_bytes() == b"[Enblend]\nCustom=1\nExe=/opt/multiblend\n"
    assert "another blender is set" in said[0] and not list(Path(hugin.data).iterdir())


def test_sequences_name_the_programs_in_full(hugin: Places, programs: Path) -> None:
    setup.install(hugin)
    assert {path.name for path in Path(hugin.data).iterdir()} == NAMES
    lines = [line for path in Path(hugin.data).iterdir() for line in path.read_text("utf-8").splitlines()]
    called = [line for line in lines if line.startswith("Program=") and line != "Program=enfuse"]
    assert sorted(set(called)) == [
        f"Program={programs / name}" for name in ("abflow-enblend", "hugin-abflow")
    ]


def test_sequences_have_all_their_steps() -> None:
    assert set(setup.sequences()) == NAMES
    for content in setup.sequences().values():
        steps = content.count("\n[Step")
        assert f"StepCount={steps}\n" in content and f"[Step{steps - 1}]" in content
        assert "Description=Panorama by optical flow" in content


def test_edited_sequences_are_kept_beside_them(hugin: Places, programs: Path) -> None:
    """Each edit once, told, under a name that Hugin does not list; where programs lie is none."""
    setup.install(hugin)
    (edited, other, *_) = sorted(Path(hugin.data).iterdir())
    moved = other.read_bytes().replace(bytes(programs), b"/else where")
    other.write_bytes(moved.replace(b"\n", b"\r\n"))  # as editors of Windows save it
    shipped = edited.read_bytes()
    first, second = shipped + b"# mine \xff\n", shipped.replace(b"[Step0]", b"[Step0]\nKeep=1")
    for content in (first, second, first):
        edited.write_bytes(content)
        planned = setup.install(hugin, dry_run=True)
        assert edited.read_bytes() == content and setup.install(hugin) == planned
        assert f"{edited} differs" in planned[0] and edited.read_bytes() == shipped
    edited.write_bytes(second)
    assert f"{edited} differs from what this version installs: it is kept as" in "\n".join(
        setup.uninstall(hugin)
    )
    kept = {f"{edited.name}.edited": first, f"{edited.name}.edited2": second}
    assert files(Path(hugin.data)) == kept


def test_link_to_the_preferences_stays_one(hugin: Places, tmp_path: Path) -> None:
    real = tmp_path / "dotfiles.conf"
    real.write_bytes(CONFIG)
    real.chmod(0o600)
    preferences = Path(hugin.preferences)
    preferences.parent.mkdir()
    preferences.symlink_to(real)
    setup.install(hugin)
    assert preferences.is_symlink() and b"abflow-enblend" in real.read_bytes()
    assert real.stat().st_mode & 0o777 == 0o600
    setup.uninstall(hugin)
    assert preferences.is_symlink() and real.read_bytes() == CONFIG


def test_link_to_no_preferences_stays_one(hugin: Places, tmp_path: Path) -> None:
    real = tmp_path / "dotfiles.conf"
    preferences = Path(hugin.preferences)
    preferences.parent.mkdir()
    preferences.symlink_to(real)
    setup.install(hugin)
    assert b"abflow-enblend" in real.read_bytes()
    setup.uninstall(hugin)
    assert preferences.is_symlink() and not real.exists()


def test_programs_that_are_not_installed(
    hugin: Places, tmp_path: Path, programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (programs / "abflow-enblend").unlink()
    monkeypatch.setenv("PATH", str(tmp_path))
    before = files(tmp_path)
    with pytest.raises(SetupError, match=r"abflow-enblend is neither beside .* nor in PATH; install"):
        setup.install(hugin)
    assert files(tmp_path) == before


def test_preferences_that_cannot_be_written(hugin: Places, tmp_path: Path) -> None:
    (tmp_path / "config").write_text("a file where a folder should be")
    with pytest.raises(SetupError, match=r"hugin\.conf cannot be (read|written): "):
        setup.install(hugin)


def test_failure_leaves_the_preferences_as_they_were(hugin: Places, tmp_path: Path) -> None:
    (tmp_path / "data").write_text("a file where a folder should be")
    before = files(tmp_path)
    with pytest.raises(SetupError, match=r"\.executor cannot be written: .*; allow writing there"):
        setup.install(hugin)
    assert files(tmp_path) == before


# Places


def test_places_on_linux() -> None:
    found = places("linux", {}, "/home/x")
    assert found.preferences == PurePosixPath("/home/x/.config/hugin.conf")
    assert found.data == PurePosixPath("/home/x/.local/share/hugin")
    found = places("linux", {"XDG_CONFIG_HOME": "/c", "XDG_DATA_HOME": "/d"}, "/home/x")
    assert (found.preferences, found.data) == (PurePosixPath("/c/hugin.conf"), PurePosixPath("/d/hugin"))


def test_places_on_windows_and_macos() -> None:
    windows = places("win32", {"APPDATA": "C:\\Users\\x\\AppData\\Roaming"}, "C:\\Users\\x")
    assert windows.preferences is None
    assert windows.data == PureWindowsPath("C:\\Users\\x\\AppData\\Roaming\\hugin")
    assert places("win32", {}, "C:\\Users\\x").data == windows.data
    macos = places("darwin", {}, "/Users/x")
    assert macos.preferences == PurePosixPath("/Users/x/Library/Preferences/hugin Preferences")


def test_what_must_be_clicked_where_preferences_are_no_file(hugin: Places, programs: Path) -> None:
    for its in (Places(None, hugin.data, False), Places(hugin.preferences, hugin.data, False)):
        said = "\n".join(setup.install(its))
        assert f"as Enblend executable choose\n    {programs / 'abflow-enblend'}\n" in said
        assert {path.name for path in Path(its.data).iterdir()} == NAMES
        assert not Path(hugin.preferences).exists()
    assert 'untick "Use alternative Enblend program"' in setup.uninstall(Places(None, hugin.data, False))[0]


# The command


@pytest.fixture
def home(tmp_path: Path, programs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path


def test_dry_run_does_nothing_and_says_what_it_would_do(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(home)
    assert setup.main(["install", "--dry-run"]) == 0
    planned = capsys.readouterr().out
    assert files(home) == before
    assert setup.main(["install"]) == 0
    assert planned == "Nothing is done; without --dry-run:\n" + capsys.readouterr().out
    installed = files(home)
    assert setup.main(["uninstall", "--dry-run"]) == 0
    assert files(home) == installed


def test_what_was_done_is_said(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "config").mkdir()
    (home / "config" / "hugin.conf").write_bytes(CONFIG)
    before = files(home)
    assert setup.main(["install"]) == 0
    said = capsys.readouterr().out
    for path in set(files(home)) - set(before) | {f"config{os.sep}hugin.conf"}:
        assert f"wrote {home / path}\n" in said
    assert setup.main(["uninstall"]) == 0
    assert capsys.readouterr().out.count("removed ") == 4
    assert files(home) == before


@pytest.mark.parametrize(
    ("arguments", "code"), [([], 2), (["remove"], 2), (["install", "-x"], 2), (["--help"], 0)]
)
def test_wrong_line_and_help(home: Path, arguments: list[str], code: int) -> None:
    before = files(home)
    assert setup.main(arguments) == code
    assert files(home) == before


def test_error_ends_in_one_line(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "config").write_text("no folder")
    assert setup.main(["install"]) == 1
    output = capsys.readouterr()
    assert output.err.startswith("hugin-abflow-setup: error: ") and output.err.count("\n") == 1
    assert "Traceback" not in output.err


@pytest.mark.skipif(sys.platform != "linux", reason="other systems' names of folders are always Unicode")
def test_folder_that_is_no_unicode_is_said_in_its_own_bytes(tmp_path: Path, programs: Path) -> None:
    line = [sys.executable, "-c", "import sys; from hugin_abflow.dropin.setup import main; sys.exit(main())"]
    environment = {**os.environ, "PATH": str(programs), "XDG_CONFIG_HOME": os.fsdecode(b"/caf\xe9")}
    environment["PYTHONIOENCODING"] = "utf-8:strict"  # what stdout is in all locales but C
    done = subprocess.run([*line, "install", "--dry-run"], env=environment, capture_output=True)
    assert done.returncode == 0 and b"wrote /caf\xe9/hugin.conf\n" in done.stdout
