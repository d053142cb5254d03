"""Run folders whose pictures are drawn: a board, and a line scan of the nominal sandwave block.

The camera of boards.py sees both.  What the sheet's thickness does is not drawn.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from boards import Light, View, render
from lines_drawn import drawn
from places import PAPER_BOARD
from synthetic_scans import Placing, scan

from lscan.acquisition.run import Run
from lscan.acquisition.writer import create_run
from lscan.config.board import load_board
from lscan.config.rig import RigFile, parse_rig
from lscan.config.targets import Sandwave
from lscan.records import Bytes, Floats, Frame, Surface

BOARD_FILE = PAPER_BOARD
VIEW = View()
BLOCK_MM = np.array([225.0, -330.0])
"""Where the block's middle lies in the sheet, x and z, when the head is above it."""

SHEET = {
    "thickness_mm": 1.5,
    "camera_mm": [225.0, -779.4, 225.0],
    "apex_mm": [225.0, 0.0, 250.0],
}
EVERY = slice(None)  # columns of a picture
FEWEST_FRAMES = 100
"""2 mm apart: ten profiles across each wedge, as few as the alignment takes."""


def rig_file(frames: int = 1, **sections: Any) -> RigFile:
    """A rig of VIEW with the paper's board and ``sections``; nothing of it can be driven."""
    document = {
        "name": "drawn",
        "camera": {"driver": "fake", "width_px": VIEW.size[0], "height_px": VIEW.size[1]},
        "track": {"driver": "fake"},
        "plan": {"frames": frames, "step_mm": 2.0},
        "stripe": {"threshold_dn": 15.0, "noise": {"read_dn": 1.0}},
        "board": load_board(BOARD_FILE).model_dump(mode="json", exclude_none=True),
        **sections,
    }
    return parse_rig(document, source="rig.toml", trusted=True)


def board_run(folder: Path, frames: int = 1, **sections: Any) -> Run:
    """Pictures of the paper's board, which stays where it is in them."""
    picture = render(load_board(BOARD_FILE), VIEW, Light(noise=0.004))
    return _written(folder, rig_file(frames, **sections), [picture] * frames)


def sandwave_run(folder: Path, frames: int = FEWEST_FRAMES, **sections: Any) -> Run:
    """The first ``frames`` pictures of a scan of the block, yawed by 2.2 degrees."""
    placing = Placing(yaw_deg=2.2, turn_deg=3.0, frames=FEWEST_FRAMES, step_mm=2.0)
    surface = scan(Sandwave(), placing)
    rng = np.random.default_rng(11)
    pictures = [_line_picture(surface, number, rng) for number in range(frames)]
    return _written(folder, rig_file(frames, **sections), pictures)


def flat_run(folder: Path, frames: int, lit: slice = EVERY, **sections: Any) -> Run:
    """A scan of something level that no rig file names; lit: the columns that show the line."""
    rng = np.random.default_rng(12)
    centre = np.full(VIEW.size[0], np.nan)
    centre[lit] = 300.0
    return _written(
        folder, rig_file(frames, **sections), [_exposed(centre, rng) for _ in range(frames)]
    )


def _line_picture(surface: Surface, number: int, rng: np.random.Generator) -> Bytes:
    """The picture of one profile: its points joined where they are neighbours."""
    seen = np.flatnonzero(np.isfinite(surface.xyz_mm[number, :, 2]))
    image = VIEW.image_px(surface.xyz_mm[number][seen][:, [0, 2]] + BLOCK_MM)
    image = image[np.argsort(image[:, 0])]
    columns = np.arange(VIEW.size[0], dtype=float)
    centre = np.interp(columns, *image.T, left=np.nan, right=np.nan)
    gap = np.searchsorted(image[:, 0], columns).clip(1, len(image) - 1)
    apart = np.abs(image[gap] - image[gap - 1]).max(axis=1)
    return _exposed(np.where(apart < 4, centre, np.nan), rng)


def _exposed(centre: Floats, rng: np.random.Generator) -> Bytes:
    """(H, W) of a line at rows ``centre`` (W,), none where NaN, on 4 DN with noise of 1 DN."""
    light = np.nan_to_num(drawn(centre, 1.5, VIEW.size[1], amplitude=150.0))
    light = cv2.GaussianBlur(light, (0, 0), 0.7)  # the line fades at its ends
    noisy = light + 4.0 + rng.normal(0.0, 1.0, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _written(folder: Path, rig: RigFile, pictures: list[Bytes]) -> Run:
    positions = rig.rig.plan.positions_mm()
    with create_run(folder, rig) as writer:
        for index, (image, position) in enumerate(zip(pictures, positions, strict=True)):
            writer.append(Frame(image, index, position, position, float(index), 20.0))
        return writer.finish()
