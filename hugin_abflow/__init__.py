"""hugin-abflow: merge Hugin panoramas with asymmetric bidirectional optical flow.

The public names; everything else may change. `hugin_abflow.pto` reads and writes Hugin projects.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hugin_abflow import pto
    from hugin_abflow.errors import AbflowError, ExitCode
    from hugin_abflow.guides import Guide
    from hugin_abflow.images import read_layer, read_layers, write_image
    from hugin_abflow.layer import Box, Canvas, Layer
    from hugin_abflow.merge import merge_layers, merge_project
    from hugin_abflow.settings import Settings
    from hugin_abflow.stitch import stitch_project

__all__ = [
    "AbflowError",
    "Box",
    "Canvas",
    "ExitCode",
    "Guide",
    "Layer",
    "Settings",
    "merge_layers",
    "merge_project",
    "pto",
    "read_layer",
    "read_layers",
    "stitch_project",
    "write_image",
]

# Loaded with the first use, so that the command can answer Ctrl-C before all is there.
_HOMES = {
    "AbflowError": "errors", "Box": "layer", "Canvas": "layer", "ExitCode": "errors", "Guide": "guides",
    "Layer": "layer", "Settings": "settings", "merge_layers": "merge", "merge_project": "merge",
    "read_layer": "images", "read_layers": "images", "stitch_project": "stitch", "write_image": "images",
}  # fmt: skip


def __dir__() -> list[str]:
    """The public names too that nobody has used yet."""
    return sorted({*globals(), *__all__})


if not TYPE_CHECKING:  # else type checkers would take every misspelled name for one of these

    def __getattr__(name: str) -> Any:
        """A public name, from the module that it lives in."""
        if name == "pto":
            return import_module("hugin_abflow.pto")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
