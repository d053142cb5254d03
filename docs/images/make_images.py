"""Make the two pictures that the README shows: ``python docs/images/make_images.py``.

``scan.png`` is one picture of the sandwave as the simulated webcam takes it, ``surface.png``
the surface that a scan of 200 such pictures gives.
"""

import os
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import lscan
import sim

HERE = Path(__file__).parent
SCENES = HERE.parents[1] / "scenes"
COLOURS = 64  # of the PNG's palette

SCENE = """
include = "{base}"
[plan]
{plan}
[render]
samples = {samples}
"""


def main() -> None:
    """Write both pictures beside this file."""
    os.chdir(tempfile.mkdtemp())
    _write(Path("board.toml"), "board", "frames = 1", samples=16)
    _write(Path("sandwave.toml"), "sandwave", "frames = 200\nstep_mm = 1.0", samples=9)
    picture = sim.render_picture(sim.load_scene(Path("sandwave.toml")), position_mm=110.0)
    _save(HERE / "scan.png", picture[170:420, 90:550])
    board = lscan.scan(lscan.load_rig(Path("board.toml")), Path("runs/board"))
    run = lscan.scan(lscan.load_rig(Path("sandwave.toml")), Path("runs/sandwave"))
    plane_map = lscan.calibrate_run(board, "refractive").plane_map
    _draw(lscan.reconstruct(run, plane_map).surface)


def _write(path: Path, base: str, plan: str, samples: int) -> None:
    text = SCENE.format(base=SCENES / "paper" / f"{base}.toml", plan=plan, samples=samples)
    path.write_text(text, encoding="utf-8")


def _draw(surface: lscan.Surface) -> None:
    good = (surface.status == lscan.Status.OK) | (surface.status == lscan.Status.SATURATED)
    xyz = np.where(good[..., None], surface.xyz_mm, np.nan)
    inside = (xyz[..., 0] > -32) & (xyz[..., 0] < 182) & (xyz[..., 1] > -32) & (xyz[..., 1] < 182)
    x, y, z = xyz[inside & (xyz[..., 2] > -15)].T
    figure = plt.figure(figsize=(4.8, 3.2), dpi=100)
    axes = figure.add_subplot(projection="3d")
    axes.scatter(x, y, z, c=z, s=1.2, cmap="viridis", linewidths=0)
    axes.set_box_aspect((1, 1, 0.22))
    axes.view_init(elev=38, azim=-62)
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_zticks([-8, 0, 8])
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1.1)
    figure.canvas.draw()
    shown = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    _save(HERE / "surface.png", shown)


def _save(path: Path, picture: np.ndarray) -> None:
    from PIL import Image

    small = Image.fromarray(picture).quantize(COLOURS, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


if __name__ == "__main__":
    main()
