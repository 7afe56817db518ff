"""The command line with nothing replaced, on a tiny project and on the sample."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from shoots import HEIGHT, PROJECT, WIDTH, textured, write_project

from hugin_abflow import cli
from hugin_abflow.batch import state
from hugin_abflow.errors import ExitCode
from hugin_abflow.project import read_plan
from hugin_abflow.terminal import system_error

ROOM = Path(__file__).resolve().parent.parent / "sample_projects" / "room"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with tiny.pto, its layers tiny0000.tif and tiny0001.tif, and no photos; what is done in
    it must leave no temporary file anywhere."""
    project, scratch = tmp_path / "project", tmp_path / "scratch"
    project.mkdir()
    scratch.mkdir()
    write_project(project / "tiny.pto")
    monkeypatch.setenv("TMPDIR", str(scratch))
    monkeypatch.setattr(tempfile, "tempdir", None)  # what tempfile found before
    yield project
    assert list(scratch.iterdir()) == []


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def read(path: Path) -> np.ndarray:
    image = oiio.ImageBuf(str(path))
    assert not image.has_error, image.geterror()
    return np.asarray(image.get_pixels(image.spec().format))


def run(folder: Path, *arguments: str) -> ExitCode:
    """Run in this process on tiny.pto and its layers; nothing but the results may appear beside them."""
    return ExitCode(cli.main([str(folder / "tiny.pto"), "--prefix", "tiny", *arguments]))


def process(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "hugin_abflow", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


# What is written


def test_default_output_lies_beside_the_project(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert run(folder) == 0
    (line,) = capsys.readouterr().out.splitlines()
    panorama = Path(line)
    assert panorama.parent == folder and panorama.suffix == ".tif"
    assert names(folder) == {path.name for path in before} | {panorama.name}
    assert {path: path.read_bytes() for path in before} == before
    pixels = read(panorama)
    assert pixels.shape == (HEIGHT, WIDTH, 4) and pixels.dtype == np.uint8
    assert (pixels[..., 3] == 255).all()
    # Both layers show the same picture, so it has to come back.
    np.testing.assert_array_equal(pixels[..., :3], textured(HEIGHT, WIDTH))


@pytest.mark.parametrize(("ending", "samples"), [("tif", 4), ("TIFF", 4), ("png", 4), ("jpg", 3)])
def test_ending_chooses_the_format(folder: Path, tmp_path: Path, ending: str, samples: int) -> None:
    output = tmp_path / f"out put.{ending}"
    assert run(folder, "-o", str(output), "--jpeg-quality", "95") == 0
    pixels = read(output)
    assert pixels.shape == (HEIGHT, WIDTH, samples)
    difference = np.abs(pixels[..., :3].astype(int) - textured(HEIGHT, WIDTH))
    assert difference.mean() < 4 if ending == "jpg" else difference.max() == 0  # chroma is subsampled in JPEG
    assert names(tmp_path) == {"project", "scratch", output.name}


def test_compression_is_obeyed(folder: Path) -> None:
    for name in ("none", "lzw", "deflate", "packbits"):
        output = folder / f"{name}.tif"
        assert run(folder, "-o", str(output), "--compression", name.upper()) == 0
        with tifffile.TiffFile(output) as written:
            assert name in written.pages[0].compression.name.lower().replace("adobe_", "")


def test_existing_panorama_is_replaced(folder: Path) -> None:
    output = folder / "out.tif"
    output.write_bytes(b"older")
    assert run(folder, "-o", str(output)) == 0
    assert read(output).shape == (HEIGHT, WIDTH, 4)


def test_layers_named_outright(folder: Path, tmp_path: Path) -> None:
    layers = [str(path.rename(tmp_path / path.name)) for path in sorted(folder.glob("*.tif"))]
    arguments = [str(folder / "tiny.pto"), "-o", str(folder / "out.png"), "--layers", *layers]
    assert cli.main(arguments) == 0
    np.testing.assert_array_equal(read(folder / "out.png")[..., :3], textured(HEIGHT, WIDTH))


def test_float_layers_make_exr(folder: Path) -> None:
    for path in folder.glob("*.tif"):
        pixels = tifffile.imread(path).astype(np.float32) / 255
        tifffile.imwrite(path, pixels, photometric="rgb", extrasamples=["unassalpha"])
    assert run(folder, "-o", str(folder / "out.exr")) == 0
    pixels = read(folder / "out.exr")
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels[..., :3], textured(HEIGHT, WIDTH) / np.float32(255), atol=1e-6)


# What goes wrong: each exit code, and nothing left behind


def broken(folder: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[ExitCode, str]:
    """Run, expect failure; gives the exit code and the message."""
    before = names(folder)
    code = ExitCode(cli.main(arguments))
    output = capsys.readouterr()
    assert names(folder) == before
    assert (
        output.out == "" and output.err.startswith("hugin-abflow: error: ") and "Traceback" not in output.err
    )
    return code, output.err


def test_project_that_is_none(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "photo.pto"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    code, message = broken(folder, [str(path)], capsys)
    assert code == ExitCode.PROJECT and "photo.pto" in message


def test_project_that_layers_have_swallowed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, message = broken(folder, ["--layers", "tiny.pto"], capsys)
    assert code == ExitCode.USAGE and "name the project first" in message


@pytest.mark.skipif(os.name == "nt", reason="Windows removes no folder that is in use")
def test_current_folder_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert cli.main(["tiny.pto"]) == ExitCode.FAILED
    assert "current folder is no longer there; go to one that is" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    assert system_error(FileNotFoundError(2, "No such file")) == "[Errno 2] No such file"  # of a socket, say


@pytest.mark.parametrize("outcome", [["--dry-run"], []], ids=["shown", "made"])
def test_lines_that_nona_does_without_are_warned_of_once(
    folder: Path, outcome: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    project = folder / "tiny.pto"
    count = project.read_text().count("\n")
    project.write_text(project.read_text() + 'k i9 t0 p"1 2 3 4 5 6"\n' * 7 + "* the end\n")
    assert run(folder, *outcome) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert len(warnings) == 6 and f"{project}, line {count + 1}: found 'i9'" in warnings[0]
    assert warnings[-1].endswith(f"{project}: 2 more such lines are left out")


def test_project_that_is_not_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, message = broken(folder, [str(folder / "gone.pto")], capsys)
    assert code == ExitCode.PROJECT and "gone.pto" in message


def test_layers_that_are_not_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--prefix", "teeny"], ["--layers", "teeny0000.tif"]):
        code, message = broken(folder, [str(folder / "tiny.pto"), *arguments], capsys)
        assert code == ExitCode.LAYERS_MISSING and "teeny0000.tif" in message


def test_layers_that_are_named_and_to_be_made(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(folder / "tiny.pto"), "--prefix", "tiny", "--remap", "always"]
    code, message = broken(folder, arguments, capsys)
    assert code == ExitCode.USAGE and "--prefix" in message


def test_photos_that_are_not_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, message = broken(folder, [str(folder / "tiny.pto"), "--remap", "always"], capsys)
    assert code == ExitCode.LAYERS_MISSING and "left.png" in message


def test_layers_that_do_not_belong_together(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "tiny0001.tif"
    pixels = tifffile.imread(path).astype(np.uint16) * 257
    tifffile.imwrite(path, pixels, photometric="rgb", extrasamples=["unassalpha"])
    code, message = broken(folder, [str(folder / "tiny.pto"), "--prefix", "tiny"], capsys)
    assert code == ExitCode.LAYERS_MISMATCH and "tiny0001.tif" in message


def test_layer_that_cannot_be_decoded(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "tiny0001.tif").write_bytes(b"no picture at all")
    code, message = broken(folder, [str(folder / "tiny.pto"), "--prefix", "tiny"], capsys)
    assert code == ExitCode.IMAGE_READ and "tiny0001.tif" in message


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["-o", "no/out.tif"], ExitCode.OUTPUT),
        (["-o", "out.xyz"], ExitCode.OUTPUT),
        (["-o", "folder.tif"], ExitCode.OUTPUT),
        (["-o", "left.png"], ExitCode.OUTPUT),
        (["-o", "out.tif", "--compression", "piz"], ExitCode.OUTPUT),
        (["-o", "out.jpg", "--compression", "lzw"], ExitCode.OUTPUT),
        (["-o", "out.png", "--compression", "zstd"], ExitCode.OUTPUT),
        (["--device", "nobody's"], ExitCode.DEVICE),
    ],
)
def test_mistakes_are_told_before_layers_are_made(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    expected: ExitCode,
) -> None:
    """nona may take minutes."""
    monkeypatch.chdir(folder)
    (folder / "folder.tif").mkdir()
    for name in ("left.png", "right.png"):
        (folder / name).write_bytes(b"no picture at all: nona would fail")
    code, message = broken(folder, ["tiny.pto", "--remap", "always", *arguments], capsys)
    assert code == expected and arguments[-1] in message


def test_photos_are_no_layers(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing in them says where they end."""
    names = [str(folder / name) for name in ("left.jpg", "right.jpg")]
    for name in names:
        buffer = oiio.ImageBuf(oiio.ImageSpec(WIDTH // 2, HEIGHT // 2, 3, "uint8"))
        assert buffer.write(name)
    code, message = broken(folder, [str(folder / "tiny.pto"), "--layers", *names], capsys)
    assert code == ExitCode.LAYERS_MISMATCH and "left.jpg has no alpha channel" in message


@pytest.mark.parametrize("output", ["no/such/folder/out.tif", "out.xyz", "."])
def test_output_that_cannot_be_written(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    monkeypatch.chdir(folder)
    code, message = broken(folder, ["tiny.pto", "--prefix", "tiny", "-o", output], capsys)
    assert code == ExitCode.OUTPUT and (output in message or output == ".")


def test_nona_that_is_not_installed(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("left.png", "right.png"):
        (folder / name).write_bytes(b"nobody looks at this")
    monkeypatch.setenv("PATH", str(folder))
    code, message = broken(folder, [str(folder / "tiny.pto"), "--remap", "always"], capsys)
    assert code == ExitCode.NONA and "nona" in message


def test_photo_that_is_none(folder: Path, nona: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("left.png", "right.png"):
        (folder / name).write_bytes(b"no picture at all")
    code, message = broken(folder, [str(folder / "tiny.pto"), "--remap", "always"], capsys)
    assert code == ExitCode.IMAGE_READ and "left.png is no image" in message


def test_device_that_is_none(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(folder / "tiny.pto"), "--prefix", "tiny", "--device", "no such device"]
    code, message = broken(folder, arguments, capsys)
    assert code == ExitCode.DEVICE and "no such device" in message


def test_one_of_two_projects_is_broken(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "empty.pto").write_bytes(b"")
    arguments = [str(folder / "empty.pto"), str(folder / "tiny.pto"), "--prefix", "tiny"]
    assert cli.main(arguments) == ExitCode.PARTIAL
    output = capsys.readouterr()
    assert len(output.out.splitlines()) == 1 and "empty.pto" in output.err


# As a process


def test_module_runs_as_a_program_and_keeps_stdout_clean(folder: Path) -> None:
    child = process("-v", "--prefix", "tiny", "-o", folder / "out.tif", folder / "tiny.pto")
    out, messages = child.communicate(timeout=120)
    assert child.returncode == 0, messages
    assert out == f"{folder / 'out.tif'}\n"
    assert "blend: " in messages


def test_verbose_says_what_is_merged(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Canvas, projection, crop, layers with their files and depth, output, device; before the work begins."""
    project = folder / "tiny.pto"
    project.write_text(PROJECT.replace(" E0 R0", " E0 R0 S10,240,5,120"))
    assert run(folder, "-v", "-o", str(folder / "out.png")) == 0
    lines = capsys.readouterr().err.splitlines()
    expected = [
        "canvas: 250 x 125, equirectangular, 360 degrees; crop: 230 x 115 at (10, 5)",
        "layers: 2, RGB, uint8",
        f"  {folder / 'tiny0000.tif'}: 250 x 125 at (0, 0)",
        f"  {folder / 'tiny0001.tif'}: 250 x 125 at (0, 0)",
        f"output: {folder / 'out.png'}, png, deflate, uint8",
    ]
    assert lines[: len(expected)] == expected
    assert lines[len(expected)].startswith("device: ")
    assert lines[len(expected) + 1] == "read ..."


@pytest.mark.parametrize("terminated", [False] if os.name == "nt" else [False, True])
@pytest.mark.parametrize(("function", "program"), [("main", "hugin-abflow"), ("enblend", "abflow-enblend")])
def test_interruption_while_modules_load_is_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str, program: str, terminated: bool
) -> None:
    stub = "import os, signal, sys; assert os.environ['OPENBLAS_NUM_THREADS'] == '1'; "
    stub += "signal.raise_signal(signal.SIGTERM)" if terminated else "raise KeyboardInterrupt"
    # parts in C++, as pyopencl's, are ended by the system where what they import is broken off
    stub += "; open('loaded', 'x').close(); del sys.modules['numpy'], sys.path[0]; import numpy"
    (tmp_path / "numpy.py").write_text(stub)
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    command = [sys.executable, "-c", f"from hugin_abflow import __main__; exit(__main__.{function}())"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == ExitCode.INTERRUPTED
    assert (done.stdout, done.stderr) == ("", f"{program}: interrupted\n")
    assert (tmp_path / "loaded").exists() == terminated
    (tmp_path / "numpy.py").unlink()
    done = subprocess.run([*command, "--version"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith(program)


def test_garbage_is_looked_for_in_a_run_but_not_among_modules(tmp_path: Path) -> None:
    stub = "import gc\nloading = gc.isenabled()\ndef main():\n"
    stub += "    print(loading, gc.isenabled(), gc.get_freeze_count())\n    return 0\n"
    (tmp_path / "stub.py").write_text(stub)
    command = [sys.executable, "-c", "from hugin_abflow.__main__ import _run; exit(_run('stub', 'stub'))"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True)
    loading, running, frozen = done.stdout.split()
    assert (loading, running) == ("False", "True") and int(frozen) > 1000


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize(
    ("number", "line", "jobs"), [(signal.SIGINT, 1, 1), (signal.SIGTERM, 8, 1), (signal.SIGTERM, 12, 3)]
)
def test_interruption_leaves_nothing(folder: Path, number: signal.Signals, line: int, jobs: int) -> None:
    for number_of in range(99):  # so that there is always something to interrupt
        (folder / f"tiny{number_of:02}.pto").write_text(PROJECT)
    before = names(folder)
    child = process("-v", "--prefix", "tiny", "--jobs", jobs, folder)
    assert child.stderr is not None
    for _ in range(line):
        child.stderr.readline()
    child.send_signal(number)
    _, messages = child.communicate(timeout=60)
    assert child.returncode == ExitCode.INTERRUPTED, messages
    assert messages.splitlines()[-1] == "hugin-abflow: interrupted" and "Traceback" not in messages
    made = names(folder) - before - {state.FOLDER}
    for name in made:  # whole, if a project was done before the signal
        assert read(folder / name).shape == (HEIGHT, WIDTH, 4)
    for record in folder.glob(f"{state.FOLDER}/*"):  # as what is told of it
        assert json.loads(record.read_text("utf-8"))
    assert len(names(folder) - before) < 90


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_interruption_ends_nona_and_removes_its_files(folder: Path, tmp_path: Path) -> None:
    for name in ("left.png", "right.png"):
        (folder / name).write_bytes(b"nobody looks at this")
    programs = tmp_path / "bin"
    programs.mkdir()
    started = tmp_path / "pid"
    (programs / "nona").write_text(
        f'#!/bin/sh\ncase "$*" in *tiny*) ;; *) echo "nona version 2022.0.0"; exit 0;; esac\n'
        f'echo $$ > "{started}.part"; mv "{started}.part" "{started}"; exec sleep 60\n'
    )
    (programs / "nona").chmod(0o755)
    before = names(folder)
    environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    child = subprocess.Popen(
        [sys.executable, "-m", "hugin_abflow", "--remap", "always", str(folder / "tiny.pto")],
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    deadline = time.monotonic() + 60
    while not started.exists() and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    child.terminate()
    _, messages = child.communicate(timeout=30)
    assert child.returncode == ExitCode.INTERRUPTED, messages
    assert names(folder) == before
    with pytest.raises(ProcessLookupError):
        os.kill(int(started.read_text()), 0)


def test_sample_merges(tmp_path: Path) -> None:
    output = tmp_path / "room.tif"
    child = process("--prefix", "room", "-o", output, ROOM / "room.pto")
    out, messages = child.communicate(timeout=300)
    assert (child.returncode, out, messages) == (0, f"{output}\n", "")
    pixels, crop = read(output), read_plan(ROOM / "room.pto").canvas.crop
    assert pixels.shape == (crop.height, crop.width, 4)
    covered = np.zeros((1024, 2048), bool)
    for path in sorted(ROOM.glob("room[0-9][0-9][0-9][0-9].tif")):
        with tifffile.TiffFile(path) as layer:
            tags = layer.pages[0].tags
            left, top = (
                round(tags[p].value[0] / tags[p].value[1] * tags[r].value[0] / tags[r].value[1])
                for p, r in (("XPosition", "XResolution"), ("YPosition", "YResolution"))
            )
            alpha = layer.asarray()[..., 3] > 127
        covered[top : top + alpha.shape[0], left : left + alpha.shape[1]] |= alpha
    covered = covered[crop.top : crop.bottom, crop.left : crop.right]
    np.testing.assert_array_equal(pixels[..., 3] == 255, covered)  # no hole, and nothing outside
