"""Rules of a rig file over several fields at once, each broken once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lscan.documents import Document


@dataclass(frozen=True)
class Crossing:
    """A rule and how to break it.

    rule: the model's validator as ``Model.name``, or what the rule says where a driver keeps
    it.  changes: keys and their new values.  key: what the message must name; words: what it
    must say besides.  camera, track, sections: the drivers and sections of a rig it fits.
    """

    rule: str
    changes: dict[str, Any]
    key: str
    words: tuple[str, ...]
    camera: str | None = None
    track: str | None = None
    sections: dict[str, Any] = field(default_factory=dict)

    def fits(self, document: Document) -> bool:
        """Whether a rig has what the rule is about; sections: with these values in them."""
        drivers = document["camera"]["driver"], document["track"]["driver"]
        asked = self.camera or drivers[0], self.track or drivers[1]
        return drivers == asked and all(
            {**document.get(name, {}), **values} == document.get(name)
            for name, values in self.sections.items()
        )


_BOARD: dict[str, Any] = {"sections": {"board": {"marks": "dark"}}}
_SIM: dict[str, Any] = {"camera": "sim", "sections": {"port": {"kind": "flat"}}}
_EMPTY = {"track.options.min_mm": 5.0, "track.options.max_mm": 5.0}
_BELOW = ("min_mm must be below max_mm", "5.0")


def _travel(track: str, start_mm: float, step_mm: float) -> Crossing:
    far = {"plan.start_mm": start_mm, "plan.step_mm": step_mm}
    words = ("travel", "0 to 10 mm", "track.options.min_mm", str(start_mm + step_mm))
    return Crossing("the plan stays within the travel", far, "plan.start_mm", words, track=track)


CROSSINGS: tuple[Crossing, ...] = (
    Crossing(
        "Grid._dots_apart",
        {"board.grid.dot_diameter_mm": 60.0},
        "board.grid",
        ("dot_diameter_mm must be smaller than pitch_mm", "60.0", "50.0"),
        **_BOARD,
    ),
    Crossing(
        "Ruler._marks_apart",
        {"board.ruler.0.mark_diameter_mm": 20.0},
        "board.ruler.0",
        ("mark_diameter_mm must be smaller than step_mm", "20.0"),
        **_BOARD,
    ),
    Crossing(
        "Ruler._marks_apart",
        {"board.ruler.0.last_mm": 5.0},
        "board.ruler.0",
        ("last_mm too close to first_mm", "5.0"),
        **_BOARD,
    ),
    Crossing(
        "Ruler._marks_apart",
        {"board.ruler.0.last_mm": -1e6},
        "board.ruler.0",
        ("step_mm is too small", "10.0"),
        **_BOARD,
    ),
    Crossing(
        "Ring._has_a_hole",
        {"board.ring.0.width_mm": 10.0},
        "board.ring.0",
        ("width_mm must be smaller than diameter_mm", "10.0"),
        **_BOARD,
    ),
    Crossing(
        "Board._names_known_and_unique",
        {"board.dot.1.name": "A"},
        "board",
        ("names used twice", "'A'"),
        **_BOARD,
    ),
    Crossing(
        "Board._names_known_and_unique",
        {"board.distances": [["A", "Z"]]},
        "board",
        ("distances name unknown dots", "'Z'"),
        **_BOARD,
    ),
    Crossing(
        "Board._names_known_and_unique",
        {"board.distances": [["A", "A"]]},
        "board",
        ("distances from a dot to itself", "'A'"),
        **_BOARD,
    ),
    Crossing(
        "Board._marks_apart",
        {"board.dot.0.x_mm": 0.0, "board.dot.0.z_mm": 0.0},
        "board",
        ("marks overlap at", "(0, 0)"),
        **_BOARD,
    ),
    Crossing(
        "OpencvOptions._one_source",
        {"camera.options.url": "http://127.0.0.1/x"},
        "camera.options",
        ("exactly one of device, url and file", "'http://127.0.0.1/x'"),
        camera="opencv",
    ),
    Crossing(
        "OpencvOptions._one_source",
        {"camera.options": {"url": "http://127.0.0.1/x", "gain": 3.0}},
        "camera.options",
        ("gain can only be set on a device", "3.0"),
        camera="opencv",
    ),
    Crossing(
        "a video file is there",
        {"camera.options": {"file": "gone.avi"}},
        "camera.options.file",
        ("no such file", "gone.avi", "allowed: a video"),
        camera="opencv",
    ),
    Crossing(
        "a recorded run is there",
        {"camera.options.run_file": "gone"},
        "camera.options.run_file",
        ("no recorded run", "gone", "allowed: the folder of a recorded run"),
        camera="replay",
    ),
    Crossing(
        "the recorded pictures are of this size",
        {"camera.width_px": 32},
        "camera.width_px",
        ("(32, 16)", "allowed: (16, 16)"),
        camera="replay",
    ),
    Crossing("SerialTrackOptions._not_empty", _EMPTY, "track.options", _BELOW, track="grbl"),
    Crossing("ManualOptions._not_empty", _EMPTY, "track.options", _BELOW, track="manual"),
    Crossing("TrackOptions._not_empty", _EMPTY, "track.options", _BELOW, track="sim"),
    *(_travel(track, 11.0, 0.0) for track in ("grbl", "manual", "sim")),
    *(_travel(track, 9.5, 1.0) for track in ("grbl", "manual", "sim")),
    *(_travel(track, 0.5, -1.0) for track in ("grbl", "manual", "sim")),
    Crossing(
        "CameraOptions._not_empty",
        {"camera.options.min_ms": 5.0, "camera.options.max_ms": 2.0},
        "camera.options",
        ("min_ms must not be above max_ms", "5.0", "2.0"),
        camera="sim",
    ),
    Crossing(
        "the target is brighter than black",
        {"camera.options.auto_exposure": True, "camera.options.target_dn": 1.0},
        "camera.options.target_dn",
        ("no brighter than black", "1.0", "allowed: above"),
        camera="sim",
    ),
    Crossing(
        "DomePort._pinhole_inside",
        {"port.centre_mm": [0.0, 0.0, 46.0]},
        "port",
        ("centre_mm must lie within 0.9 radius_mm", "46.0", "50.0"),
        sections={"port": {"kind": "dome"}},
    ),
    Crossing(
        "Laser._consistent",
        {"laser.lines.0.share": 0.6, "laser.lines": [{"tilt_deg": 0.0, "share": 0.6}] * 2},
        "laser",
        ("shares of the power add up to 1.2", "0.6"),
        **_SIM,
    ),
    Crossing(
        "Laser._consistent",
        {"laser.drift.nm_per_c": 20.0},
        "laser",
        ("warms up to 850 nm", "450 to 700", "20.0"),
        **_SIM,
    ),
    Crossing(
        "Laser._consistent",
        {"laser.fan": "gaussian", "laser.fan_rise": 0.5},
        "laser",
        ("fan_rise goes with", '"uniform"', "0.5"),
        **_SIM,
    ),
    Crossing(
        "Water._one_way",
        {"water.kind": "pure", "water.absorption_per_m": 1.0},
        "water",
        ("absorption_per_m exclude each other", "1.0"),
        **_SIM,
    ),
    Crossing(
        "Water._one_way",
        {"water.kind": "tank"},
        "water",
        ("turbidity_ntu goes with", "'tank'"),
        **_SIM,
    ),
    Crossing(
        "Water._one_way",
        {"water.absorption_per_m": 1.0},
        "water",
        ("absorption_per_m and scattering_per_m go together", "1.0"),
        **_SIM,
    ),
    Crossing(
        "Target._consistent",
        {"target.shape": "mesh"},
        "target",
        ('file goes with shape = "mesh"', "'mesh'"),
        **_SIM,
    ),
    Crossing(
        "Target._consistent",
        {"target.albedo": [[650.0, 0.5], [600.0, 0.5]]},
        "target",
        ("albedo: two or more pairs, their wavelengths rising", "650.0"),
        **_SIM,
    ),
    Crossing(
        "the target's section is there",
        {"target.shape": "workpiece"},
        "target.shape",
        ("'workpiece'", "[workpiece]"),
        **_SIM,
    ),
    Crossing(
        "a texture is there",
        {"target.texture.file": "gone.png"},
        "target.texture.file",
        ("no such file", "gone.png", "allowed: a file"),
        **_SIM,
    ),
    Crossing(
        "Render._square",
        {"render.samples": 8},
        "render",
        ("samples must be a square number", "8"),
        **_SIM,
    ),
    Crossing(
        "the lens does not fold the picture",
        {"lens.k1": -5.0},
        "lens",
        ("folds the picture", "-5.0", "allowed: coefficients"),
        **_SIM,
    ),
)
