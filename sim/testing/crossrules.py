"""Rules of a rig file over several fields at once, each broken once."""

from __future__ import annotations

from typing import Any

from sim.testing.crossing import Crossing
from sim.testing.tankrules import TANK_CROSSINGS

_BOARD: dict[str, Any] = {"sections": {"board": {"marks": "dark"}}}
_TURNED: dict[str, Any] = {"sections": {"shaft": {}}}
_SHAFT = {"point_mm": [0.0, 0.0, 500.0], "direction": [1.0, 0.0, 0.0]}
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
        "Board._marks_apart",
        {"board.ring.0.x_mm": 5.0, "board.ring.0.z_mm": -50.0},
        "board",
        ("ring E runs over the mark at (0, -50)",),
        **_BOARD,
    ),
    Crossing(
        "ShaftSection._usable",
        {"shaft.direction": [0.0, 0.0, 0.0]},
        "shaft",
        ("direction must not be zero", "[0.0, 0.0, 0.0]"),
        **_TURNED,
    ),
    Crossing(
        "ShaftSection._usable",
        {"shaft.direction": [0.0, 2.0, 0.03]},
        "shaft",
        ("direction lies along y", "1 degree or more", "[0.0, 2.0, 0.03]"),
        **_TURNED,
    ),
    Crossing(
        "ShaftSection._usable",
        {"shaft.correlation": [0.9, 0.9, 0.0, 0.0, -0.9, 0.0, 0.0, 0.0, 0.0, 0.0]},
        "shaft",
        ("correlation must be that of five quantities", "[0.9, 0.9, 0.0"),
        **_TURNED,
    ),
    Crossing(
        "a shaft turns once at most",
        {"plan.frames": 3, "plan.step_mm": 181.0},
        "plan",
        ("more than a full turn about [shaft]", "362 deg", "allowed: 360 deg"),
        **_TURNED,
    ),
    Crossing(
        "no sheet's thickness about a shaft",
        {"shaft": _SHAFT},
        "sheet",
        ("linear track only", "allowed: [sheet] or [shaft]"),
        sections={"sheet": {}},
    ),
    Crossing(
        "the track switches the laser",
        {"plan.laser": "on"},
        "plan.laser",
        ("'manual' switches no laser", "got 'on'", "allowed: untouched"),
        track="manual",
    ),
    Crossing(
        "a video has no pairs",
        {"camera.options": {"file": "video.avi"}, "plan.laser": "pairs"},
        "plan.laser",
        ("a video file", "got 'pairs'", "allowed: untouched, on"),
        camera="opencv",
        track="grbl",
    ),
    Crossing(
        "pairs are replayed of a run taken in pairs",
        {"plan.laser": "pairs"},
        "plan.laser",
        ("recorded without backgrounds", "got 'pairs'", "allowed: untouched, on"),
        camera="replay",
        track="replay",
    ),
    Crossing(
        "a function of the user's is there",
        {"stripe.extractor": "no_such_module:function"},
        "stripe.extractor",
        ("no_such_module:function", "allowed: a name that can be imported"),
        sections={"stripe": {}},
    ),
    Crossing(
        "a function of the user's can be called",
        {"stripe.extractor": "math:pi"},
        "stripe.extractor",
        ("math:pi", "allowed: a function"),
        sections={"stripe": {}},
    ),
    Crossing(
        "a plane map's variant is known",
        {"calibration.plane_map": "polynomial-99"},
        "calibration.plane_map",
        ("polynomial-99", "allowed: polynomial-1 to polynomial-9"),
        sections={"calibration": {}},
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
    *TANK_CROSSINGS,
)
