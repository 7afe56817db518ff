"""Panoramas for which there is no room: full disks, and limits for one file."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import names_in, noise, on_small_disk

from hugin_abflow.errors import OutputError
from hugin_abflow.images import ImageWriter, write_image


@pytest.mark.parametrize(("ending", "share"), [(".tif", 0.5), (".tif", 0.9999), (".png", 0.5)])
def test_full_disk(tmp_path, ending, share):
    """A limit on file size stands for a full disk: in the middle, and where only the end does not fit."""
    resource = pytest.importorskip("resource")
    import signal

    old_action = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    write_image(tmp_path / f"a{ending}", noise(np.uint16, width=401, height=301))
    size = (tmp_path / f"a{ending}").stat().st_size
    (tmp_path / f"a{ending}").unlink()
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(size * share), hard))
    try:
        with pytest.raises(OutputError, match=rf"a\{ending} cannot be written: [^\n]*;"):
            write_image(tmp_path / f"a{ending}", noise(np.uint16, width=401, height=301))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old_action)
    assert not names_in(tmp_path)


def test_jpeg_stops_before_the_disk_is_full(tmp_path, monkeypatch):
    """libjpeg would end the process there. Disks that do not tell their size are written to."""
    disk = SimpleNamespace(total=1 << 30, free=1 << 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: disk)
    pixels = noise(np.uint8, width=401, height=301)
    with ImageWriter(tmp_path / "a.jpg", 401, 602, 3, np.uint8) as writer:
        writer.write_rows(pixels)
        disk.free = 1 << 18
        with pytest.raises(OutputError, match=r"a\.jpg cannot be written: No space left on device"):
            writer.write_rows(pixels)
        disk.free = 1 << 20
        writer.write_rows(pixels)
    assert names_in(tmp_path) == ["a.jpg"]
    disk.total = disk.free = 0
    write_image(tmp_path / "b.jpg", pixels)
    assert (tmp_path / "b.jpg").is_file()


_LIMITED = """
import os, resource, sys, numpy as np
from hugin_abflow.errors import OutputError
from hugin_abflow.images import write_image
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
write_image("small" + sys.argv[1], np.zeros((9, 9, 4), np.float32))
try:
    noise = np.random.default_rng(0).integers(0, 256, (401, 603, 4), np.uint8)
    write_image("a" + sys.argv[1], noise.astype(np.float32) / 255)
except OutputError as error:
    print(error)
print(os.listdir("."))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="cannot tell in advance there, or has no such limits")
@pytest.mark.parametrize("ending", [".jpg", ".png", ".tif", ".exr"])
def test_a_limit_for_one_file_is_told(tmp_path, ending):
    """libjpeg ended the process there, and left its temporary file."""
    command = [sys.executable, "-c", _LIMITED, ending]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    refused, left = done.stdout.splitlines()
    assert refused.startswith(f"a{ending} cannot be written: ") and done.returncode == 0
    assert left == f"['small{ending}']"


_ON_A_FULL_DISK = """
import os, sys, numpy as np
from hugin_abflow.errors import OutputError
from hugin_abflow.images import ImageWriter
noise = np.random.default_rng(0).integers(0, 256, (4, 4001, 4), np.uint8)
for rows, height in ((4, 3003), (0, 40003)):  # it fills up; even blanks have no room
    try:
        with ImageWriter("a.jpg", 4001, height, 3, np.uint8) as writer:
            for _ in range(height // 4 if rows else 0):
                writer.write_rows(noise)
    except OutputError as error:
        print(error)
print(os.listdir("."))
"""


def test_jpeg_is_given_up_on_a_full_disk(tmp_path):
    """OpenImageIO completes a JPEG that is given up; without room for that libjpeg ended the process."""
    done = on_small_disk(tmp_path, "1m", shlex.join([sys.executable, "-c", _ON_A_FULL_DISK]))
    *refused, left = done.stdout.splitlines()
    assert len(refused) == 2 and all("a.jpg cannot be written: No space left" in line for line in refused)
    assert left == "[]" and done.returncode == 0
