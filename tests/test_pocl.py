"""PoCL compiles on processors that its compiler does not know, and where no home can be written."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import age

from hugin_abflow import pocl
from hugin_abflow.opencl import Device, choose

HERE = sys.platform == "linux" and platform.machine() == "x86_64"
only_linux = pytest.mark.skipif(sys.platform != "linux", reason="caches are elsewhere on other systems")
only_here = pytest.mark.skipif(not HERE, reason="no help there")

AVX2 = {"sse2", "sse4_2", "popcnt", "avx", "avx2", "fma", "f16c", "bmi1", "bmi2", "abm", "movbe"}
AVX512 = AVX2 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "adx", "clflushopt"}


def version_of(processor: str, system: str = "unknown-linux-gnu") -> str:
    """What PoCL says of a device whose processor it calls so."""
    return f"OpenCL 3.0 PoCL HSTR: pthread-x86_64-{system}-{processor}"


class Record(ctypes.Structure):
    """Some of what drivers keep of a device: numbers, and addresses good and bad."""

    _fields_ = (
        ("table", ctypes.c_void_p),
        ("kind", ctypes.c_uint64),
        ("nowhere", ctypes.c_void_p),
        ("long_name", ctypes.c_char_p),
        ("triplet", ctypes.c_char_p),
        ("processor", ctypes.c_char_p),
        ("rest", ctypes.c_char * pocl._RECORD),
    )


def record_of(processor: bytes) -> Record:
    return Record(
        0, (1 << 64) - 1, 8, b"a processor", b"x86_64-unknown-linux-gnu", processor, b"\xff" * pocl._RECORD
    )


@only_here
def test_the_name_alone_is_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pocl, "_processor", lambda: ("AuthenticAMD", AVX2))
    record = record_of(b"generic")
    before = bytes(record)
    pocl.name_processor(version_of("generic"), "3.0-rc2", ctypes.addressof(record))
    assert record.processor == b"haswell"
    field = Record.processor
    after = bytearray(bytes(record))
    after[field.offset : field.offset + field.size] = before[field.offset : field.offset + field.size]
    assert bytes(after) == before


@only_here
@pytest.mark.parametrize("guess", ["znver1", "znver2", "znver3"])
@pytest.mark.parametrize("features, named", [(AVX2, None), (AVX512, "skylake-avx512"), ({"avx512f"}, None)])
def test_a_name_without_avx512_goes_where_there_is_avx512(
    guess: str, features: set[str], named: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PoCL loads its functions for AVX-512 there, as on Zen 4, which its compiler takes for Zen 3."""
    monkeypatch.setattr(pocl, "_processor", lambda: ("AuthenticAMD", features))
    record = record_of(guess.encode())
    pocl.name_processor(version_of(guess), "3.0-rc2", ctypes.addressof(record))
    assert record.processor == (named or guess).encode()


@only_here
@pytest.mark.parametrize(
    "maker, driver, features, named",
    [
        ("GenuineIntel", "3.0-rc2", AVX512, "haswell"),
        ("GenuineIntel", "3.0", AVX512 - {"movbe"}, None),
        ("GenuineIntel", "3.0", AVX2, None),  # it makes none for AVX-512
        ("GenuineIntel", "6.0", AVX512, None),
        ("AuthenticAMD", "3.0-rc2", AVX512, None),
    ],
)
@pytest.mark.parametrize("own", ["rocketlake", "skylake-avx512"])
def test_slow_code_for_avx512_is_not_made(
    own: str, maker: str, driver: str, features: set[str], named: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pocl, "_processor", lambda: (maker, features))
    record = record_of(own.encode())
    pocl.name_processor(version_of(own), driver, ctypes.addressof(record))
    assert record.processor == (named or own).encode()


@only_here
@pytest.mark.parametrize("system", ["pc-linux-gnu", "suse-linux", "alpine-linux-musl"])
@pytest.mark.parametrize("own", ["generic", "skylake-avx512"])
def test_the_name_is_found_whatever_the_system_is_called(
    own: str, system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pocl, "_processor", lambda: ("GenuineIntel", AVX512))
    record = record_of(own.encode())
    pocl.name_processor(version_of(own, system), "3.0-rc2", ctypes.addressof(record))
    assert record.processor == b"haswell"


@only_here
def test_a_name_stays() -> None:
    for processor in (b"znver3", b"generic-rv64"):
        record = record_of(processor)
        pocl.name_processor(version_of("generic"), "3.0-rc2", ctypes.addressof(record))
        assert record.processor == processor


@only_here
@pytest.mark.parametrize(
    "version",
    [
        version_of("haswell"),
        version_of("znver4"),
        "OpenCL 3.0 CUDA 12.4.0",
        version_of("generic").replace("PoCL", "of another kind"),
    ],
)
def test_other_devices_are_left_alone(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pocl, "_processor", lambda: ("AuthenticAMD", AVX2))
    record = record_of(b"generic")
    pocl.name_processor(version, "3.0-rc2", ctypes.addressof(record))
    assert record.processor == b"generic"


@only_here
def test_what_cannot_be_read_is_no_error() -> None:
    pocl.name_processor(version_of("generic"), "3.0-rc2", 8)


def test_processors_are_taken_for_what_their_library_is_compiled_for() -> None:
    assert pocl._like(AVX512 | {"avx512_vp2intersect", "sha_ni"}) == "skylake-avx512"
    assert pocl._like(AVX2 | {"sha_ni"}) == "haswell"


def test_what_could_not_run_is_not_guessed() -> None:
    assert pocl._like({"sse2", "avx"}) is None
    for missing in AVX2 - {"sse2", "avx", "avx2"}:
        assert pocl._like(AVX2 - {missing}) is None
    for missing in AVX512 - AVX2 - {"avx512f"}:  # the library is that of AVX-512, whatever else there is
        assert pocl._like(AVX512 - {missing}) is None


# With long vectors, of 16 numbers.
OPTIONS = "-DPIXEL=uchar -DSAMPLES=4 -DWHITE=255.0f -DINTEGER=1 -DPIXELS=4 -DBLOCK=64"

_RENAMED_RUN = """
import sys
from hugin_abflow import pocl
from hugin_abflow.opencl import Device, choose

chosen = choose(None)
assert pocl._rename(chosen.int_ptr, sys.argv[1], sys.argv[3])
pocl.name_processor(sys.argv[2], "3.0-rc2", chosen.int_ptr)
print(sorted(Device(threads=1).build("blend", sys.argv[4])))
"""


@only_here
@pytest.mark.parametrize("guess", ["generic", "znver3"])
def test_a_processor_with_another_name_builds(guess: str, device: Device, tmp_path: Path) -> None:
    """This machine's own is given that name first."""
    version = device.device.version
    if "PoCL" not in version or "-gnu-" not in version:
        pytest.skip("the device is none of PoCL's")  # only those are named
    _, features = pocl._processor()
    if pocl._like(features) is None or (guess != "generic" and "avx512f" not in features):
        # programs would be built for what it cannot do
        pytest.skip("this processor can do less than those that PoCL may be told of")
    own = version.partition("-gnu-")[2]
    done = subprocess.run(
        [sys.executable, "-c", _RENAMED_RUN, own, version_of(guess), guess, OPTIONS],
        timeout=120,
        env=os.environ | {"POCL_CACHE_DIR": str(tmp_path), "PYOPENCL_NO_CACHE": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "blend_band" in done.stdout


_CORES_RUN = """
import os
import sys
from hugin_abflow.opencl import Device, choose

used = [Device(threads=int(threads)) for threads in sys.argv[1:]]
assert "POCL_CPU_MAX_CU_COUNT" not in os.environ  # for other programs, it says nothing
print(choose(None).platform.name, choose(None).max_compute_units, used[-1].device.max_compute_units)
"""


@pytest.mark.parametrize(
    ("asked", "said", "whole", "part"),
    [
        ((1,), {}, 1, 1),
        ((0, 1), {}, None, 1),  # too late for PoCL to hear: a part of the device, as far as it goes
        ((1, 0), {}, 1, 1),  # PoCL asks once
        ((0,), {"POCL_MAX_PTHREAD_COUNT": "1"}, 1, 1),
        ((1 << 10,), {}, None, None),
    ],
)
def test_pocl_itself_uses_as_many_cores_as_it_may(
    device: Device, asked: tuple[int, ...], said: dict[str, str], whole: int | None, part: int | None
) -> None:
    """The device that it offers has no more: its parts calculate on all cores of it. None: all."""
    if "PoCL" not in device.device.version:
        pytest.skip("the device is none of PoCL's")  # whose variables these are
    environment = {name: value for name, value in os.environ.items() if name not in pocl._CORES}
    done = subprocess.run(
        [sys.executable, "-c", _CORES_RUN, *map(str, asked)],
        timeout=120,
        env=environment | said,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    every = choose(None).max_compute_units
    assert done.stdout.split()[-2:] == [str(whole or every), str(part or every)]


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A user whose home is no folder; returns where temporary files are."""
    (tmp_path / "home").touch()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", "")  # and so put back what it was
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


@only_linux
@pytest.mark.parametrize("name", ["HOME", "XDG_CACHE_HOME"])
def test_a_cache_that_can_be_written_stays(
    monkeypatch: pytest.MonkeyPatch, nobody: Path, name: str, tmp_path: Path
) -> None:
    monkeypatch.setenv(name, str(tmp_path / "to be made"))
    before = dict(os.environ)
    pocl.find_cache()
    assert dict(os.environ) == before
    assert not list(nobody.iterdir())


@only_linux
def test_without_a_home_the_cache_is_ones_own(nobody: Path) -> None:
    for _ in range(2):  # the second run finds the first one's
        os.environ.pop("XDG_CACHE_HOME", None)
        pocl.find_cache()
        (cache,) = nobody.iterdir()
        assert os.environ["XDG_CACHE_HOME"] == str(cache)
        assert cache.stat().st_mode & 0o777 == 0o700


@only_linux
@pytest.mark.parametrize("blocked", ["pocl", "pocl/kcache", "pytools", "."])
def test_a_cache_that_is_blocked_is_none(
    monkeypatch: pytest.MonkeyPatch, nobody: Path, tmp_path: Path, blocked: str
) -> None:
    """By a file in place of a folder, or a link to what is not there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    place = tmp_path / "cache" / blocked
    if blocked == ".":
        place.symlink_to(tmp_path / "gone")
    else:
        place.parent.mkdir(parents=True)
        place.touch()
    pocl.find_cache()
    assert Path(os.environ["XDG_CACHE_HOME"]).parent == nobody


@only_linux
def test_the_cache_is_the_same_from_everywhere(monkeypatch: pytest.MonkeyPatch, nobody: Path) -> None:
    """pyopencl takes no notice of a relative one."""
    monkeypatch.chdir(nobody.parent)
    monkeypatch.setenv("TMPDIR", nobody.name)
    pocl.find_cache()
    assert Path(os.environ["XDG_CACHE_HOME"]).parent == nobody


@only_linux
def test_a_home_that_is_not_named_is_looked_up(monkeypatch: pytest.MonkeyPatch, nobody: Path) -> None:
    """PoCL alone would take a folder that belongs to whoever came first."""
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(Path, "home", lambda: nobody)
    pocl.find_cache()
    assert os.environ["XDG_CACHE_HOME"] == f"{nobody}/.cache"
    monkeypatch.delenv("XDG_CACHE_HOME")

    def unknown() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", unknown)
    pocl.find_cache()
    assert Path(os.environ["XDG_CACHE_HOME"]).parent == nobody


@only_linux
def test_programs_of_others_are_not_run(monkeypatch: pytest.MonkeyPatch, nobody: Path) -> None:
    monkeypatch.setattr(pocl, "_PLACES", (str(nobody),))
    pocl.find_cache()
    (cache,) = nobody.iterdir()
    spoils = [lambda: cache.chmod(0o720), lambda: cache.chmod(0o702)]
    spoils += [lambda: (cache.rmdir(), cache.symlink_to(nobody)), lambda: (cache.unlink(), cache.touch())]
    if os.getuid() == 0:
        spoils += [lambda: (cache.unlink(), cache.mkdir(0o700), os.chown(cache, 1, 1))]
    for spoil in spoils:
        os.environ.pop("XDG_CACHE_HOME", None)
        spoil()
        pocl.find_cache()
        assert "XDG_CACHE_HOME" not in os.environ


@only_linux
@pytest.mark.parametrize("fault", [{"f_bavail": 1}, {"f_flag": getattr(os, "ST_NOEXEC", 0)}])
def test_disks_that_hold_no_programs_are_passed_over(
    monkeypatch: pytest.MonkeyPatch, nobody: Path, fault: dict[str, int]
) -> None:
    """Full ones, and those from which none may be run."""
    home, good = nobody / "home", {"f_blocks": 1 << 20, "f_bavail": 1 << 20, "f_frsize": 4096, "f_flag": 0}
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setattr(
        os, "statvfs", lambda path: SimpleNamespace(**good | (fault if home in (path, *path.parents) else {}))
    )
    pocl.find_cache()
    assert Path(os.environ["XDG_CACHE_HOME"]).parent == nobody
    assert not list(home.iterdir())


@only_linux
def test_a_named_cache_that_holds_no_programs_is_not_used(
    monkeypatch: pytest.MonkeyPatch, nobody: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """PoCL would end the process, or have no device."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(nobody))
    pocl.find_cache()
    assert pocl.kernel_folder() == nobody and not caplog.messages
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "home" / "cache"))  # home is no folder
    for _ in range(2):
        pocl.find_cache()
    assert "POCL_CACHE_DIR" not in os.environ
    (said,) = caplog.messages
    assert f"'{tmp_path}/home/cache', which cannot hold" in said and "32 MiB" in said
    monkeypatch.setenv("POCL_CACHE_DIR", "")  # which is no folder
    pocl.find_cache()
    assert "POCL_CACHE_DIR" not in os.environ and "POCL_CACHE_DIR is ''" in caplog.messages[1]


@only_linux
def test_no_place_for_a_cache_is_said(
    monkeypatch: pytest.MonkeyPatch, nobody: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(pocl, "_holds_programs", lambda folder: False)
    pocl.find_cache()
    assert "XDG_CACHE_HOME" not in os.environ
    (said,) = caplog.messages
    assert "set XDG_CACHE_HOME" in said and "32 MiB" in said


_HOMELESS_RUN = """
from hugin_abflow.opencl import Device

device = Device()
print(sorted(device.build("pyramid")), device.zeros((2, 3)).get().sum())
"""


@only_linux
def test_kernels_are_built_without_a_home(nobody: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _HOMELESS_RUN],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "pyramid_" in done.stdout
    assert not done.stderr


def test_programs_without_content_are_removed_from_the_kept_ones(tmp_path: Path) -> None:
    """Not what may be written just now, and not what is empty as it is."""
    entry = tmp_path / "EG" / "PDHGI"
    (entry / "kernel" / "256-1-1").mkdir(parents=True)
    places = {
        "gone": [entry / "program.bc", entry / "kernel" / "256-1-1" / "kernel.so"],
        "stays": [entry / "last_accessed", tmp_path / "tempfile_a", entry / "kernel" / "new.so"],
        "whole": [entry / "kernel" / "whole.so"],
    }
    for file in chain(*places.values()):
        file.write_bytes(b"code" if file in places["whole"] else b"")
        if file.name != "new.so":
            age(file, 100)
    pocl.mend(tmp_path)
    assert not any(file.exists() for file in places["gone"])
    assert all(file.exists() for file in places["stays"] + places["whole"])
    pocl.mend(tmp_path / "none")


@only_linux
def test_kept_kernels_that_a_power_cut_emptied_are_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = """
import numpy as np
from hugin_abflow.opencl import Device
device = Device()
assert "pocl" in device.device.version.lower(), "no PoCL"
print(device.zeros((3, 5)).fill(2).get().sum(), len(device.build("pyramid")))
"""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("POCL_CACHE_DIR", raising=False)

    def build() -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)

    first = build()
    if "no PoCL" in first.stderr:
        pytest.skip("the first device is not PoCL's")
    programs = list((tmp_path / "pocl").rglob("program.bc"))
    assert first.returncode == 0 and programs
    for program in programs:
        program.write_bytes(b"")
        age(program, 100)
    second = build()
    assert (second.returncode, second.stdout) == (0, first.stdout), second.stderr
