"""Hugin's project files (.pto): read, look up, edit, write back without changing anything else.

    project = pto.load("room.pto")
    for image in project.images:
        print(image.filename, image.variable("v"))
    project.panorama.crop = (0, 10, 4000, 1990)
    pto.dump(project, "cropped.pto")

A malformed file raises `PtoError` with its line. What nona does without is left out: see `Project.doubts`.
"""

from hugin_abflow.errors import PtoError
from hugin_abflow.pto.fields import Box
from hugin_abflow.pto.lines import ControlPoint, Mask, Modes, Panorama, VariableLine
from hugin_abflow.pto.model import Image, Project
from hugin_abflow.pto.parser import load, loads
from hugin_abflow.pto.writer import dump, dumps

__all__ = [
    "Box",
    "ControlPoint",
    "Image",
    "Mask",
    "Modes",
    "Panorama",
    "Project",
    "PtoError",
    "VariableLine",
    "dump",
    "dumps",
    "load",
    "loads",
]
