"""The grooved block: Table III, once for each seed."""

from collections.abc import Sequence

from lscan.calibration.planemap import PlaneMap
from lscan.config.targets import GroovedBlock
from lscan.measure import groove_dimensions
from lscan.records import Length
from sim.scene import Scene
from sim.validation.accuracy.exposures import read_scan


def dimensions(
    scene: Scene, seeds: Sequence[int], plane_maps: Sequence[PlaneMap]
) -> list[dict[str, Length]]:
    """Table III from the scene's scan: one for each seed, through that seed's own map."""
    readings = read_scan(scene, scene.rig.plan.positions_mm(), seeds, scene.rig.stripe)
    piece = scene.rig.workpiece
    assert isinstance(piece, GroovedBlock)
    return [
        groove_dimensions(reading.profiles(plane_map), piece)
        for reading, plane_map in zip(readings, plane_maps, strict=True)
    ]
