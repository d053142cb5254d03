"""The rig file that the served tank writes of itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from served import quick_rig, small_scene

from lscan.acquire import scan
from lscan.documents import Document
from lscan.samerig import first_difference
from sim.serve import EmulatedHardware, ServeOptions
from sim.serve.rigfile import rig_document


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
    document = rig_document(small_scene(plan=plan), {}, {}, switched_laser=switched)
    assert document["plan"].get("laser") == laser
    assert document["plan"]["frames"] == 4


def test_a_scan_with_the_rig_of_a_switched_laser_sees_the_line(tmp_path: Path) -> None:
    """Red of the line against what the room leaves: dark, no pixel is above the threshold."""
    scene = small_scene(plan={"frames": 1})
    with EmulatedHardware(scene, ServeOptions(switched_laser=True)) as hardware:
        rig_file = quick_rig(hardware)
        run = scan(rig_file, tmp_path / "run")
    assert run.frame(0).image[..., 0].max() > rig_file.rig.stripe.threshold_dn
