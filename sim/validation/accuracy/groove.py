"""The grooved block: Table III, once for each seed."""

from __future__ import annotations

from collections.abc import Sequence

from lscan.calibration.api import PlaneMap
from lscan.config.targets import GroovedBlock
from lscan.measure import groove_dimensions
from lscan.records import Length
from lscan.surface.profile import to_profile
from sim.scene import Scene
from sim.validation.accuracy.exposures import ScanReading, read_scan


def dimensions(
    scene: Scene, seeds: Sequence[int], plane_maps: Sequence[PlaneMap]
) -> list[dict[str, Length]]:
    """Table III from the scene's scan: one for each seed, through that seed's own map."""
    readings = read_scan(scene, scene.rig.plan.positions_mm(), seeds, scene.rig.stripe)
    return [
        _measured(scene, reading, plane_map)
        for reading, plane_map in zip(readings, plane_maps, strict=True)
    ]


def _measured(scene: Scene, reading: ScanReading, plane_map: PlaneMap) -> dict[str, Length]:
    piece = scene.rig.workpiece
    assert isinstance(piece, GroovedBlock)
    profiles = [
        to_profile(stripe, plane_map, position)
        for stripe, position in zip(reading.stripes, reading.positions_mm, strict=True)
    ]
    return groove_dimensions(profiles, piece)
