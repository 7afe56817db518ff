"""hugin-abflow: merge Hugin panoramas with asymmetric bidirectional optical flow.

The public names; everything else may change. `hugin_abflow.pto` reads and writes Hugin projects.
"""

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
