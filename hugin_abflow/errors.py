"""Everything that can go wrong, one class per cause; causes that are mended alike share an exit code.

The library raises these; only the command line prints them and exits. A message names the file,
says what is wrong and what to do about it.
"""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of ``hugin-abflow``; documented in README and tested."""

    OK = 0
    FAILED = 1  # an error without a code of its own
    USAGE = 2  # the command line itself is wrong (click's own code)
    PROJECT = 3  # the .pto file cannot be read or makes no panorama
    LAYERS_MISSING = 4  # layers or photos are not there
    LAYERS_MISMATCH = 5  # layers, or photos, do not belong together
    IMAGE_READ = 6  # an image cannot be decoded
    OUTPUT = 7  # the panorama cannot be written
    NONA = 8  # nona is missing or failed
    DEVICE = 9  # no usable OpenCL device
    PARTIAL = 10  # several projects: some succeeded, some failed
    ALL_FAILED = 11  # several projects: none succeeded
    PROGRAM = 12  # another program of Hugin's, or enfuse, is missing or failed
    CLUSTER = 13  # the Dask cluster does not answer, or gave a project up
    INTERRUPTED = 130  # Ctrl-C


# What they mean, as README and --help have it.
EXIT_CODES = {
    ExitCode.OK: "every panorama was written",
    ExitCode.FAILED: "any other error",
    ExitCode.USAGE: "the command line is wrong",
    ExitCode.PROJECT: "the project cannot be read, makes no panorama, or is about a photo of another size",
    ExitCode.LAYERS_MISSING: "layers or photos are missing",
    ExitCode.LAYERS_MISMATCH: "the layers, or the photos, do not belong together (size, depth or channels)",
    ExitCode.IMAGE_READ: "a layer or photo cannot be decoded",
    ExitCode.OUTPUT: "the panorama cannot be written",
    ExitCode.NONA: "nona is missing, or failed",
    ExitCode.DEVICE: "no usable OpenCL device",
    ExitCode.PARTIAL: "several projects: some succeeded, some failed",
    ExitCode.ALL_FAILED: "several projects: all failed",
    ExitCode.PROGRAM: "enfuse, hugin_hdrmerge or pano_trafo is missing, or failed",
    ExitCode.CLUSTER: "the Dask cluster does not answer, or gave a project up",
    ExitCode.INTERRUPTED: "interrupted (Ctrl-C, SIGTERM); nothing half-written is left",
}


class AbflowError(Exception):
    """Base of all errors that hugin-abflow raises on purpose."""

    exit_code: ExitCode = ExitCode.FAILED


class ProjectError(AbflowError):
    """The project is well-formed but makes no panorama (no active image, an empty crop ...)."""

    exit_code = ExitCode.PROJECT


class PtoError(ProjectError):
    """A .pto file breaks the grammar.

    Attributes: ``file`` (name or ``<bytes>``), ``line`` (from 1; 0 for the file as a whole),
    ``token`` (the offending text) and ``expected``.
    """

    def __init__(self, file: str, line: int, token: str, expected: str) -> None:
        self.file, self.line, self.token, self.expected = file, line, token, expected
        where = f"{file}, line {line}" if line else file
        super().__init__(f"{where}: found {token!r}, expected {expected}")

    def __reduce__(self) -> tuple[type[PtoError], tuple[str, int, str, str]]:
        return type(self), (self.file, self.line, self.token, self.expected)


class LayersMissingError(AbflowError):
    """Layers are not there and cannot be made."""

    exit_code = ExitCode.LAYERS_MISSING


class CanvasError(AbflowError):
    """A canvas has no pixels, or its crop has none or some that are beyond it."""

    exit_code = ExitCode.PROJECT


class GuideError(AbflowError):
    """A guide is not about two of the layers, or about no place."""

    exit_code = ExitCode.PROJECT


class PhotoMissingError(AbflowError):
    """A photo that nona would need is not there."""

    exit_code = ExitCode.LAYERS_MISSING


class LayersMismatchError(AbflowError):
    """Layers differ in canvas size, depth or channel count, or photos in depth or channel count."""

    exit_code = ExitCode.LAYERS_MISMATCH


class ImageReadError(AbflowError):
    """A layer or photo cannot be opened or decoded."""

    exit_code = ExitCode.IMAGE_READ


class OutputError(AbflowError):
    """The panorama cannot be written."""

    exit_code = ExitCode.OUTPUT


class NonaMissingError(AbflowError):
    """nona is not installed or not in PATH."""

    exit_code = ExitCode.NONA


class NonaFailedError(AbflowError):
    """nona ran and failed."""

    exit_code = ExitCode.NONA


class ProgramMissingError(AbflowError):
    """A program that an output needs is not installed or not in PATH."""

    exit_code = ExitCode.PROGRAM


class ProgramFailedError(AbflowError):
    """A program that an output needs ran and failed."""

    exit_code = ExitCode.PROGRAM


class DeviceError(AbflowError):
    """No OpenCL device, none that fits ``--device``, or the device failed."""

    exit_code = ExitCode.DEVICE


class SettingsError(AbflowError):
    """A setting is out of its range or of a wrong type."""

    exit_code = ExitCode.USAGE


class SameOutputError(AbflowError):
    """Two projects of a run would write the same file, or two options name one."""

    exit_code = ExitCode.USAGE


class ClusterError(AbflowError):
    """The Dask cluster cannot be used."""

    exit_code = ExitCode.CLUSTER


class ConfigError(AbflowError):
    """A file of settings is wrong."""

    exit_code = ExitCode.USAGE


class CommandLineError(AbflowError):
    """A command line in enblend's manner is wrong."""

    exit_code = ExitCode.USAGE


class SetupError(AbflowError):
    """Hugin's preferences or output sequences cannot be set up."""
