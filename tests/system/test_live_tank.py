"""The live page's board on the tank: its offset from the sheet, and the picture."""

import time
from pathlib import Path

import numpy as np
import pytest
from places import SCENES

from lscan.acquisition.run import open_run
from lscan.board import read_board
from lscan.calibration.calibrate import calibrate
from lscan.calibration.calibrationfile import load_calibration
from lscan.config.rig import SheetSection, load_rig
from lscan.live.analysis import read_live_board
from lscan.live.session import Session
from lscan.records import Bytes
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from tests.validation.exposures import pictures
from tests.validation.instrument.board import OFFSET_MM, TILT_DEG, misaligned

pytestmark = pytest.mark.slow

SCENE = SCENES / "paper" / "board.toml"
LONG_S = 120.0


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    """The paper's board with a quarter of its samples, which still draws its dots true."""
    path = tmp_path / "board.toml"
    path.write_text(f'include = "{SCENE}"\n[render]\nsamples = 16\n')
    return path


def picture(scene: Scene, seed: int) -> Bytes:
    image: Bytes = pictures(scene, Tank(scene).render(0.0), [seed])[0]
    return image


def test_the_offset_of_a_misplaced_board_is_within_its_uncertainty(quick: Path) -> None:
    """The sheet is where the board lay when the map was solved; three sigma, 1 in 370 each."""
    scene = load_scene(quick)
    rig, board = scene.rig, scene.rig.board
    assert board is not None
    camera_mm = scene.tank.head.camera_mm
    by_ruler = SheetSection(thickness_mm=1.0, camera_mm=camera_mm, apex_mm=(225.0, 0.0, 500.0))
    rig = rig.model_copy(update={"sheet": by_ruler})
    well = read_board(picture(scene, 61), board, channel=rig.calibration.channel)
    plane_map = calibrate(well, "graticule-2", rig.optics).plane_map
    reading = read_live_board(picture(misaligned(scene), 62), board, rig, plane_map)
    offset = reading.offset
    assert offset is not None, reading.offset_message
    assert abs(offset.distance_mm - OFFSET_MM) < 3 * offset.distance_sigma_mm
    assert abs(offset.tilt_x_rad - np.radians(TILT_DEG)) < 3 * offset.tilt_x_sigma_rad
    assert abs(offset.tilt_z_rad) < 3 * offset.tilt_z_sigma_rad
    # And it is of use: a tenth of the offset.
    assert offset.distance_sigma_mm < 0.2
    assert np.degrees(offset.tilt_x_sigma_rad) < 0.05


def test_the_board_picture_of_the_page_is_that_of_the_commands(quick: Path, tmp_path: Path) -> None:
    rig_file = load_rig(quick)
    session = Session(rig_file, tmp_path / "runs")
    try:
        session.take_board()
        deadline_s = time.monotonic() + LONG_S
        while session.state()["task"]["name"]:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        state = session.state()
    finally:
        session.close()
    path = tmp_path / "runs" / "board-001.json"
    assert state["calibration"] == str(path), state["task"]["message"]
    run = open_run(tmp_path / "runs" / "board-001")
    assert (run.state, len(run)) == ("complete", 1)
    rig = rig_file.rig
    assert rig.board is not None
    reading = read_board(run.frame(0).image, rig.board, channel=rig.calibration.channel)
    again = calibrate(reading, rig.calibration.plane_map, rig.optics)
    kept = load_calibration(path)
    assert kept.plane_map.parameters() == again.plane_map.parameters()
    assert f"{again.rms_px:.3f} px" in state["task"]["message"]
