"""Tiny projects with their layers, which need neither photos nor nona."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

WIDTH, HEIGHT = 250, 125  # pixels of the tiny canvas

LENS = "Eev0 Er1 Eb1 r0 p0 TrX0 TrY0 TrZ0 Tpy0 Tpp0 j0"
PROJECT = f"""# hugin project file
#hugin_ptoversion 2
p f2 w{WIDTH} h{HEIGHT} v360  k0 E0 R0 n"TIFF_m c:LZW r:CROP"
m i0

# image lines
#-hugin  cropFactor=1
i w120 h120 f3 v240 a0 b0 c0 d0 e0 g0 t0 Ra0 Rb0 Rc0 Rd0 Re0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 {LENS} y-90 n"left.png"
#-hugin  cropFactor=1
i w120 h120 f3 v=0 a=0 b=0 c=0 d=0 e=0 g=0 t=0 Va=0 Vb=0 Vc=0 Vd=0 {LENS} y90 n"right.png"

#hugin_outputImageType tif
#hugin_outputImageTypeCompression LZW
"""


class Deaf:
    """A listener who does not listen."""

    def phase_began(self, name: str, total: int) -> None: ...
    def advanced(self, name: str, units: int) -> None: ...
    def phase_ended(self, name: str, seconds: float) -> None: ...
    def message(self, level: int, text: str, left: str = "") -> None: ...


def textured(height: int, width: int) -> np.ndarray:
    """A smooth pattern, (height, width, 3) uint8, without a repeat."""
    y, x = np.mgrid[:height, :width]
    waves = [
        120 + 60 * np.sin(x / a + y * y / 900) + 50 * np.cos(y / b) for a, b in ((7, 5), (11, 9), (5, 13))
    ]
    return np.stack(waves, axis=2).astype(np.uint8)


def write_project(path: Path) -> Path:
    """A project and its two layers, named after it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(PROJECT)
    pixels = textured(HEIGHT, WIDTH)
    x = np.arange(WIDTH)
    for number, covered in enumerate([x < 0.6 * WIDTH, (x > 0.4 * WIDTH) | (x < 0.1 * WIDTH)]):
        alpha = np.broadcast_to(covered, (HEIGHT, WIDTH))[..., None] * np.uint8(255)
        layer = np.concatenate([pixels * (alpha > 0), alpha], axis=2)
        file = path.with_name(f"{path.stem}{number:04}.tif")
        tifffile.imwrite(file, layer, photometric="rgb", extrasamples=["unassalpha"])
    return path
