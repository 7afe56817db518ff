"""What still holds is skipped, and nothing else: changes of inputs, settings and panoramas are seen."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from conftest import age, names_in
from shoots import HEIGHT, WIDTH, Deaf, write_project

from hugin_abflow import cli, outputs, scratch
from hugin_abflow.batch import state, task
from hugin_abflow.batch.record import Record
from hugin_abflow.batch.task import Task, perform
from hugin_abflow.imagewriter import ImageWriter
from hugin_abflow.settings import Settings

Make = Callable[..., Record]
PHOTO = np.full((120, 120, 3), 7, np.uint8)


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    folder = tmp_path / "shoot"
    write_project(folder / "tiny.pto")
    tifffile.imwrite(folder / "right.png", PHOTO)
    for file in folder.iterdir():
        age(file, 60)
    return folder


@pytest.fixture
def make(shoot: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Stitch tiny.pto as a batch does; a panorama is written, but quickly."""

    def merge(path: Path, output: Path | None = None, **keywords: Any) -> Path:
        target = output or path.with_suffix(".tif")
        pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8) + np.uint8(len(list(path.parent.iterdir())))
        tifffile.imwrite(target, pixels, photometric="rgb", extrasamples=["unassalpha"], software=False)
        return target

    monkeypatch.setattr(
        task, "stitch_project", lambda path, finished, **keywords: finished(merge(path, **keywords))
    )

    def run(folder: Path = shoot, resume: bool = True, **options: object) -> Record:
        keywords = {"settings": Settings(), "output": None, "remap": "auto"} | options
        return perform(Task(folder / "tiny.pto", keywords, resume, remember=True), Deaf())

    return run


def test_dry_run_leaves_out_what_holds(make: Make, shoot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the options of the run; with --force, and of one project without --resume, it is made."""
    options = {**cli_options(), "settings": Settings()}
    make(**options)
    holds = f"# {shoot / 'tiny.pto'}: tiny.tif: made before, left as it is (--force: anew)\n"
    for arguments, shown in (
        ([str(shoot)], True),
        (["--resume", str(shoot / "tiny.pto")], True),
        ([str(shoot / "tiny.pto")], False),
        (["--force", str(shoot)], False),
        (["--seam", "off", str(shoot)], False),
    ):
        assert cli.main(["--dry-run", *arguments]) == 0
        said = capsys.readouterr().out
        assert (said == holds) == shown and ("hugin-abflow -o" in said or "--seam off" in said) != shown


def cli_options() -> dict[str, Any]:
    """Keywords of `stitch_project` as the command line has them where nothing is said."""
    return {
        "prefix": None, "layers": None, "keep_layers": False, "compression": None, "jpeg_quality": None,
        "metadata": True,
    }  # fmt: skip


def test_what_holds_is_skipped_and_recorded_as_it_was(make: Make, shoot: Path) -> None:
    first = make()
    assert first.result == "made" and first.warnings == []
    written = (shoot / "tiny.tif").stat()
    second = make()
    assert second.result == "skipped" and second.exit_code == 0 and second.warnings == []
    assert second.outputs == [{"file": str(shoot / "tiny.tif"), "bytes": written.st_size}]
    assert [Path(entry["file"]).name for entry in second.inputs] == [
        "tiny.pto", "right.png", "tiny0000.tif", "tiny0001.tif",
    ]  # fmt: skip
    assert (shoot / "tiny.tif").stat().st_mtime_ns == written.st_mtime_ns
    assert make(resume=False).result == "made"


def test_what_a_killed_run_left_goes_where_all_holds_too(make: Make, shoot: Path) -> None:
    make()
    left = f"abflow-{scratch._HOST}-0123456789ab"
    parts = [shoot / f".{left}.tif", shoot / ".abflow" / f".{left}.part"]
    for part in parts:
        part.touch()
    assert make().result == "skipped"
    assert not any(part.exists() for part in parts)


def test_state_is_readable_and_lies_beside_the_panorama(make: Make, shoot: Path, tmp_path: Path) -> None:
    make()
    assert names_in(shoot / ".abflow") == ["tiny.pto.json"]
    known = json.loads((shoot / ".abflow" / "tiny.pto.json").read_text("utf-8"))
    assert known["settings"]["merge"] == "joint" and known["version"]
    assert [entry["file"] for entry in known["outputs"]] == ["tiny.tif"]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    assert make(output=elsewhere / "big.tif").result == "made"
    assert names_in(elsewhere) == [".abflow", "big.tif"]
    assert names_in(elsewhere / ".abflow") == ["big.tif.json"]
    assert make(output=elsewhere / "big.tif").result == make().result == "skipped"


@pytest.mark.parametrize("name", ["tiny.pto", "right.png", "tiny0000.tif"])
def test_changed_input_is_seen_even_with_the_old_size(make: Make, shoot: Path, name: str) -> None:
    make()
    content = bytearray((shoot / name).read_bytes())
    content[-3 if name == "tiny.pto" else 100] ^= 1
    (shoot / name).write_bytes(bytes(content))
    assert make().result == "made"
    assert make().result == "skipped"


def test_touched_input_is_not_changed(make: Make, shoot: Path) -> None:
    make()
    for name in ("tiny.pto", "right.png", "tiny0000.tif", "tiny.tif"):
        os.utime(shoot / name)
    assert make().result == "skipped"


def test_new_and_lost_inputs_are_seen(make: Make, shoot: Path) -> None:
    make()
    tifffile.imwrite(shoot / "left.png", PHOTO)
    assert make().result == "made"
    (shoot / "tiny0001.tif").unlink()
    assert make().result == "made"
    assert make().result == "skipped"


def test_input_that_changes_meanwhile_counts_as_changed(
    make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    merge = task.stitch_project

    def slow(path: Path, **keywords: Any) -> list[Path]:
        (shoot / "right.png").write_bytes(b"saved again while the panorama was made")
        return merge(path, **keywords)

    monkeypatch.setattr(task, "stitch_project", slow)
    make()
    monkeypatch.setattr(task, "stitch_project", merge)
    assert make().result == "made"


def test_layers_that_were_kept_are_no_change(
    make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (shoot / "tiny0001.tif").rename(shoot / "made by nona")
    merge = task.stitch_project

    def keep(path: Path, **keywords: Any) -> list[Path]:
        shutil.copy(shoot / "made by nona", shoot / "tiny0001.tif")
        return merge(path, **keywords)

    monkeypatch.setattr(task, "stitch_project", keep)
    assert make(keep_layers=True).result == "made"
    assert make(keep_layers=True).result == "skipped"


@pytest.mark.parametrize(
    "options",
    [{"settings": Settings(seam=False)}, {"jpeg_quality": 80}, {"prefix": "tiny"}, {"metadata": False}],
    ids=str,
)
def test_another_setting_makes_another_panorama(make: Make, options: dict[str, Any]) -> None:
    make()
    assert make(**options).result == "made"
    assert make(**options).result == "skipped"


@pytest.mark.parametrize(
    "options", [{"settings": Settings(device="0", band_rows=64)}, {"remap": "never"}], ids=str
)
def test_how_the_work_is_done_does_not_count(make: Make, options: dict[str, Any]) -> None:
    make()
    assert make(**options).result == "skipped"


def test_another_version_makes_another_panorama(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    make()
    monkeypatch.setattr(state, "version", lambda: "99.0")
    assert make().result == "made"


def test_panorama_that_is_gone_or_damaged_is_made_again(make: Make, shoot: Path) -> None:
    make()
    (shoot / "tiny.tif").unlink()
    assert make().result == "made"
    whole = (shoot / "tiny.tif").read_bytes()
    for damaged in (whole[: len(whole) // 2], b""):
        (shoot / "tiny.tif").write_bytes(damaged)
        assert make().result == "made"
        assert len((shoot / "tiny.tif").read_bytes()) == len(whole)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".exr"])
def test_damage_is_seen_in_every_format(tmp_path: Path, ending: str) -> None:
    """Of JPEG as well, in place of which decoders paint grey."""
    path, rows = tmp_path / f"a{ending}", np.random.default_rng(1).integers(0, 255, (90, 120, 4), np.uint8)
    pixels = rows if ending != ".exr" else (rows / 255).astype(np.float32)
    with ImageWriter(path, 120, 90, 3, pixels.dtype) as writer:
        writer.write_rows(pixels)
    content = path.read_bytes()
    assert state._decodes(path)
    half = len(content) // 2
    for damaged in (content[:half], content[:half] + bytes(len(content) - half), content[:9], b""):
        path.write_bytes(damaged)
        assert not state._decodes(path)
    if ending == ".jpg":
        path.write_bytes(content + b"appended by a camera")
        assert state._decodes(path)


LACKING = {"enfuse": "install it"}.get


def ask_for_fused_too(shoot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which lacks its program."""
    with (shoot / "tiny.pto").open("a") as file:
        file.write("#hugin_outputLDRBlended true\n#hugin_outputLDRExposureBlended true\n")
    monkeypatch.setattr(outputs, "missing", LACKING)


def test_output_that_lacked_its_program_is_made_once_that_is_there(
    make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask_for_fused_too(shoot, monkeypatch)
    make()
    record = make()
    assert record.result == "skipped" and "fused from stacks (install it)" in record.warnings[0]
    monkeypatch.setattr(outputs, "missing", lambda program: None)
    assert make().result == "made"
    monkeypatch.setattr(outputs, "missing", LACKING)
    assert make().result == "skipped"


def test_what_nobody_is_to_make_is_nobody_s_to_leave(
    make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody made himself what was left out; where all holds, it would not be replaced."""
    ask_for_fused_too(shoot, monkeypatch)
    make()
    tifffile.imwrite(shoot / "tiny_fused.tif", PHOTO, software="GIMP 2.10")
    record = make()
    assert record.result == "skipped" and record.files == [shoot / "tiny.tif"]
    (warning,) = record.warnings
    assert "left out" in warning


def test_panorama_that_was_retouched_is_left_as_it_is(make: Make, shoot: Path) -> None:
    make()
    retouch(shoot / "tiny.tif")
    record = make()
    assert record.result == "skipped"
    (warning,) = record.warnings
    assert "tiny.tif was changed since it was made; it is left as it is (--force" in warning
    assert (tifffile.imread(shoot / "tiny.tif") == PHOTO).all()


def retouch(file: Path) -> None:
    tifffile.imwrite(file, PHOTO)


@pytest.mark.parametrize("options", [{}, {"settings": Settings(seam=False)}, {"jpeg_quality": 80}], ids=str)
@pytest.mark.parametrize("name", ["tiny.pto", "right.png"])
def test_it_is_left_whatever_else_changed(
    make: Make, shoot: Path, name: str, options: dict[str, Any]
) -> None:
    """A comment in the project is enough for another panorama; somebody's work is not lost for that."""
    make()
    retouch(shoot / "tiny.tif")
    with (shoot / name).open("a") as file:
        file.write("# a comment\n")
    for _ in range(2):
        record = make(**options)
        assert record.result == "skipped" and record.files == [shoot / "tiny.tif"]
        (warning,) = record.warnings
        assert "tiny.tif was changed since it was made, and so were project, photos" in warning
        assert "--force makes it anew" in warning
    assert (tifffile.imread(shoot / "tiny.tif") == PHOTO).all()
    assert make(resume=False, **options).result == "made"
    assert make(**options).warnings == []


def test_it_is_left_in_colours_that_no_layer_has(make: Make, shoot: Path) -> None:
    """Such as CMYK for a printer; it was taken for damaged."""
    make()
    tifffile.imwrite(shoot / "tiny.tif", np.zeros((5, 7, 4), np.uint8), photometric="separated")
    record = make()
    assert record.result == "skipped" and "was changed since it was made" in record.warnings[0]


def test_it_is_left_where_an_output_is_gone_that_is_asked_for_no_more(
    make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    merge = task.stitch_project

    def both(path: Path, finished: Callable[[Path], None], **keywords: Any) -> None:
        merge(path, finished, **keywords)
        finished(Path(shutil.copy(shoot / "tiny.tif", shoot / "tiny_fused.tif")))

    monkeypatch.setattr(task, "stitch_project", both)
    assert make().files == [shoot / "tiny.tif", shoot / "tiny_fused.tif"]
    retouch(shoot / "tiny.tif")
    (shoot / "tiny_fused.tif").unlink()
    record = make()
    assert record.files == [shoot / "tiny.tif"] and "tiny.tif was changed since" in record.warnings[0]
    assert (tifffile.imread(shoot / "tiny.tif") == PHOTO).all()


def test_painted_layers_are_blended_anew(make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are outputs where remapped images are asked for, but inputs, too, and never replaced."""
    merge = task.stitch_project

    def both(path: Path, finished: Callable[[Path], None], **keywords: Any) -> None:
        finished(shoot / "tiny0000.tif")
        merge(path, finished, **keywords)

    monkeypatch.setattr(task, "stitch_project", both)
    make()
    retouch(shoot / "tiny0000.tif")
    assert make().result == "made"


@pytest.mark.parametrize("how", ["killed", "failed", "not to be remembered"])
def test_panorama_that_is_made_anew_was_not_retouched(
    make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """By a run that could not, or need not, say of what it is made."""
    make()
    with (shoot / "tiny.pto").open("a") as file:
        file.write("# a comment\n")
    merge = task.stitch_project

    def part(path: Path, finished: Callable[[Path], None], **keywords: Any) -> None:
        merge(path, finished, **keywords)
        if how != "not to be remembered":
            raise KeyboardInterrupt if how == "killed" else RuntimeError("a bug")

    monkeypatch.setattr(task, "stitch_project", part)
    options = {"settings": Settings(), "output": None, "remap": "auto"}
    with suppress(KeyboardInterrupt):
        perform(Task(shoot / "tiny.pto", options, remember=how == "killed"), Deaf())
    monkeypatch.setattr(task, "stitch_project", merge)
    written = (shoot / "tiny.tif").read_bytes()
    retouch(shoot / "tiny.tif")
    assert make().result == "skipped"
    (shoot / "tiny.tif").write_bytes(written)
    assert make().result == "made"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        "[" * 100_000,
        '{"schema": 1}',
        '{"inputs": 3}',
        '{"inputs": [{"file": []}]}',
        '{"schema": 1, "hash": 3, "inputs": [1], "outputs": "x"}',
    ],
    ids=lambda text: text[:30],
)
def test_state_of_somebody_else_is_none(make: Make, shoot: Path, text: str) -> None:
    make()
    (shoot / ".abflow" / "tiny.pto.json").write_text(text)
    assert make().result == "made"


@pytest.mark.parametrize(
    "damage", ['"bytes": null', '"bytes": "x"', '"bytes": 1e999', '"device": 7', '"overlaps": 7']
)
def test_damaged_state_is_none(make: Make, shoot: Path, damage: str) -> None:
    """It ended the run in a traceback, when the table was printed."""
    make()
    file = shoot / ".abflow" / "tiny.pto.json"
    name = damage.split(":")[0]
    text, count = re.subn(rf'{name}: (\d+|"[^"]*"|\[\])', damage, file.read_text())
    assert count
    file.write_text(text)
    record = make()
    assert record.result == "made" and record.bytes > 0


def test_folder_can_be_moved_as_a_whole(make: Make, shoot: Path) -> None:
    make()
    moved = shoot.rename(shoot.with_name("archive"))
    record = make(folder=moved)
    assert record.result == "skipped" and record.files == [moved / "tiny.tif"]


def test_failure_is_not_remembered(make: Make, shoot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, **keywords: Any) -> Path:
        raise RuntimeError("a bug")

    monkeypatch.setattr(task, "stitch_project", fail)
    assert make().result == "failed"
    assert not (shoot / ".abflow").exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows writes out only what is open for writing")
def test_panorama_that_must_not_be_written_is_flushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that replaces such a file keeps its permissions. Root may write it all the same."""
    import fcntl  # Unix alone has it

    flags: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: flags.append(fcntl.fcntl(file, fcntl.F_GETFL)))
    (tmp_path / "a.tif").touch(0o444)
    state._flush(tmp_path / "a.tif")
    assert [flag & os.O_ACCMODE for flag in flags] == [os.O_RDONLY]


def test_state_that_cannot_be_written_is_a_warning(make: Make, shoot: Path) -> None:
    (shoot / ".abflow").write_text("a file where the folder belongs")
    record = make()
    assert record.result == "made" and record.exit_code == 0
    file = shoot / ".abflow" / "tiny.pto.json"
    assert record.warnings == [
        f"{file} cannot be written (File exists): {shoot / 'tiny.pto'} will be made again"
    ]
