"""The rig file that the served tank writes of itself."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from served import PAPER, quick_rig, small_scene

from lscan.acquisition.run import first_difference
from lscan.acquisition.scan import scan
from lscan.config.documents import Document
from lscan.config.rig import SheetSection, load_rig
from sim.emulators import EmulatedHardware, ServeOptions
from sim.emulators.hardware import rig_document


def test_the_tank_served_anew_writes_the_same_rig_but_for_its_address(tmp_path: Path) -> None:
    """However long it rendered: the link is the lasting name of the port."""
    scene, options = small_scene(), ServeOptions(link=tmp_path / "track")
    documents: list[Document] = []
    for _ in range(2):
        with EmulatedHardware(scene, options) as hardware:
            documents.append(hardware.rig_document())
            del documents[-1]["camera"]["options"]["url"]
    assert first_difference(*documents) is None


@pytest.mark.parametrize(
    ("plan", "switched", "laser"),
    [
        ({}, True, "on"),
        ({"laser": "pairs"}, True, "pairs"),
        ({"laser": "untouched"}, True, "untouched"),
        ({}, False, None),
    ],
)
def test_the_plan_lights_a_laser_that_is_switched(
    plan: dict[str, Any], switched: bool, laser: str | None
) -> None:
    document = rig_document(small_scene(plan=plan), "", {}, switched_laser=switched)
    assert document["plan"].get("laser") == laser
    assert document["plan"]["frames"] == 4


def test_the_rig_says_where_the_sheet_is_lit_and_seen_from() -> None:
    """As the ruler of scenes/best does in the same tank; a beam is thicker off its waist.

    At the Rayleigh length pi w0² n / lambda, 104 mm for w0 = 0.127 mm at 650 nm in water of
    index 1.33, it is sqrt(2) as thick.
    """
    tank = small_scene()
    best = load_rig(PAPER.parent / "best" / "sandwave.toml").rig.sheet
    assert best is not None
    specified = SheetSection(**rig_document(tank, "", {})["sheet"])
    for key, value in specified:
        assert value == pytest.approx(getattr(best, key), abs=0.05), key  # mm, as rounded there
    # The camera's axis, 30 degrees down, meets the sheet 500 mm under the camera at 300 mm, which
    # is 450 mm under the apex.
    laser = {"waist_mm": 0.127, "waist_distance_mm": 450.0 - 104.0}
    thick = rig_document(small_scene(laser=laser), "", {})["sheet"]["thickness_mm"]
    assert thick == pytest.approx(0.127 * np.sqrt(2), abs=0.006)  # rounded to 0.01


def test_a_sheet_in_the_scene_is_the_rigs_own() -> None:
    own = {"thickness_mm": 2.0, "camera_mm": [0.0, -1.0, 0.0], "apex_mm": [0.0, 0.0, 1.0]}
    assert rig_document(small_scene(sheet=own), "", {})["sheet"] == own
    away = small_scene(head={"heading_deg": 180.0})  # the camera's back to the sheet
    assert "sheet" not in rig_document(away, "", {})


def test_a_scan_with_the_rig_of_a_switched_laser_sees_the_line(tmp_path: Path) -> None:
    """Red of the line against what the room leaves: dark, no pixel is above the threshold."""
    scene = small_scene(plan={"frames": 1})
    with EmulatedHardware(scene, ServeOptions(switched_laser=True)) as hardware:
        rig_file = quick_rig(hardware)
        run = scan(rig_file, tmp_path / "run")
    assert run.frame(0).image[..., 0].max() > rig_file.rig.stripe.threshold_dn
