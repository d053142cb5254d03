"""Rules over several fields of what a rig file says of the tank, each broken once."""

from __future__ import annotations

from typing import Any

from sim.testing.crossing import Crossing

_SIM: dict[str, Any] = {"camera": "sim", "sections": {"port": {"kind": "flat"}}}
_PIECE: dict[str, Any] = {"camera": "sim", "sections": {"target": {"shape": "workpiece"}}}
_TURNED: dict[str, Any] = {"sections": {"shaft": {}}}
_SHAFT = {"point_mm": [0.0, 0.0, 500.0], "direction": [1.0, 0.0, 0.0]}

TANK_CROSSINGS: tuple[Crossing, ...] = (
    Crossing(
        "TrueShaft._has_direction",
        {"head.shaft.direction": [0.0, 0.0, 0.0]},
        "head.shaft",
        ("direction must not be zero", "[0.0, 0.0, 0.0]"),
        camera="sim",
        **_TURNED,
    ),
    Crossing(
        "a true shaft needs the rig's",
        {"head.shaft": _SHAFT},
        "head.shaft",
        ("needs the section [shaft]", "allowed: head.shaft left out"),
        **_SIM,
    ),
    Crossing(
        "a head on a shaft stands still",
        {"head.speed_mm_s": 1.5},
        "head.speed_mm_s",
        ("stands still", "got 1.5", "allowed: 0"),
        camera="sim",
        **_TURNED,
    ),
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
        {"target.unit": "m"},
        "target",
        ('unit goes with shape = "mesh" only', "'m'"),
        **_SIM,
    ),
    Crossing(
        "Target._consistent",
        {"target.albedo": [[650.0, 0.5], [600.0, 0.5]]},
        "target",
        ("albedo: two or more pairs, their wavelengths rising", "650.0"),
        **_SIM,
    ),
    *(
        Crossing(
            "the target's section is there",
            {"target.shape": shape},
            "target.shape",
            (f"got '{shape}'", f"allowed: the section [{shape}]"),
            **_SIM,
        )
        for shape in ("board", "workpiece")
    ),
    Crossing(
        "a texture is there",
        {"target.texture.file": "gone.png"},
        "target.texture.file",
        ("no such file", "gone.png", "allowed: a file"),
        **_PIECE,
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
