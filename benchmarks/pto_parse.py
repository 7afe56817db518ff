"""Time to read and write a large project: ``python benchmarks/pto_parse.py [IMAGES] [CONTROL_POINTS]``.

The target is under 2 s for 5,000 images and 200,000 control points.
"""

from __future__ import annotations

import random
import sys
import time

from hugin_abflow import pto

LENS = ["v", "Ra", "Rb", "Rc", "Rd", "Re", "a", "b", "c", "d", "e", "g", "t"]
LENS += ["Va", "Vb", "Vc", "Vd", "Vx", "Vy"]


def project_text(images: int, points: int) -> bytes:
    """A project as Hugin writes it: all images share the first one's lens, points between neighbours."""
    rng = random.Random(1)
    lines = [
        "# hugin project file",
        "#hugin_ptoversion 2",
        'p f2 w30001 h15000 v360  k0 E11.5 R0 n"TIFF_m c:LZW r:CROP"',
        "m i0",
    ]
    for index in range(images):
        lens = " ".join(f"{key}=0" if index else f"{key}{rng.uniform(1, 50)!r}" for key in LENS)
        place = " ".join(f"{key}{rng.uniform(-180, 180)!r}" for key in ("Eev", "Er", "Eb", "r", "p", "y"))
        shift = "TrX0 TrY0 TrZ0 Tpy0 Tpp0 j0"
        lines.append("#-hugin  cropFactor=1.5")
        lines.append(f'i w6000 h4000 f0 {lens} {place} {shift}  Vm5 n"photos/IMG_{index:05d}.JPG"')
    lines += [f"v {key}{index}" for index in range(images) for key in ("r", "p", "y")]
    for _ in range(points):
        first = rng.randrange(images - 1)
        x, y, x2, y2 = (f"{rng.uniform(0, 4000):.12f}" for _ in range(4))
        lines.append(f"c n{first} N{first + 1} x{x} y{y} X{x2} Y{y2} t0")
    lines += ["#hugin_blender enblend", "#hugin_outputImageType tif", ""]
    return "\n".join(lines).encode()


def main() -> None:
    """Print the best of three of each step."""
    images, points = (int(text) for text in [*sys.argv[1:3], *("5000", "200000")[len(sys.argv) - 1 :]])
    data = project_text(images, points)
    print(f"{images} images, {points} control points, {len(data) / 1e6:.1f} MB")
    loaded = min((timed(lambda: pto.loads(data)) for _ in range(3)), key=lambda pair: pair[0])
    written = min((timed(lambda: pto.dumps(loaded[1])) for _ in range(3)), key=lambda pair: pair[0])
    touched = timed(lambda: sum(point.x1 for point in loaded[1].control_points))
    for name, seconds in (("loads", loaded[0]), ("dumps", written[0]), ("every control point", touched[0])):
        print(f"{name:20} {seconds:6.2f} s")
    assert written[1] == data


def timed(step):
    """Seconds of wall time of a step, and its result."""
    start = time.perf_counter()
    result = step()
    return time.perf_counter() - start, result


if __name__ == "__main__":
    main()
