"""A rig of chosen parts in chosen places, as the document of a scene."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, hypot, pi, radians, sqrt, tan
from typing import Any

import numpy as np

from lscan.config.documents import Document, check, merge
from lscan.config.rig import parse_rig
from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import SECTIONS, Head, Scene, camera_pose, scene_of
from sim.scene.file import TankSections
from sim.scene.instrument import FULL_SCALE_DN, PlanePort, Response
from sim.sensor.radiometry import speckle_contrast
from sim.studies.design.catalogue import (
    CameraPart,
    LaserPart,
    LensPart,
    Objective,
    TrackPart,
    WindowPart,
)
from sim.truth import line_brightness, project, stripe_truths
from sim.truth.sheet import sheet_of
from sim.truth.visibility import fan_angle
from sim.water import glass_index, water_optics

# How much of the sheet a rig measures: where a level and an upright line are lit and seen.


PIECES = 4000
"""Of a line whose ends are looked for; between them they are found by linear interpolation."""
REACH = 3.0
"""How far the upright line is looked at beyond the aim, in distances of the camera from it."""


def aim_mm(head: Head) -> Floats:
    """(3,) where the camera's axis meets the plane y = 0, head frame, mm; refraction apart.

    Parameters
    ----------
    head : Head, whose camera looks towards the plane
    """
    pose = camera_pose(head)
    axis = pose.rotation[:, 2]
    return np.asarray(pose.origin_mm - axis * pose.origin_mm[1] / axis[1])


def measured_mm(scene: Scene) -> tuple[float, float]:
    """Measured width and depth range, mm.

    The width is that of a level line through the place in the sheet that the camera aims at, as far
    as the laser's fan reaches and the camera sees it; the depth range that of an upright line
    through the same place.  0 where the place itself is not lit or not seen.

    Parameters
    ----------
    scene : Scene, its target left out
    """
    x, y, z = aim_mm(scene.tank.head)
    apex_z = scene.tank.laser.apex_mm[2]
    far = REACH * float(np.linalg.norm(np.array(scene.tank.head.camera_mm) - [x, y, z]))
    level = np.column_stack([x + np.linspace(-far, far, PIECES + 1), np.full(PIECES + 1, z)])
    upright = np.column_stack([np.full(PIECES + 1, x), z + np.linspace(-far, far, PIECES + 1)])
    upright = upright[upright[:, 1] < apex_z]
    return _extent(scene, level, (x, z)), _extent(scene, upright, (x, z))


def _extent(scene: Scene, line_mm: Floats, middle_mm: tuple[float, float]) -> float:
    """Length of the part of a line of the sheet, about its middle, that is lit and seen.

    line_mm: (N, 2) evenly along it.
    """
    if len(line_mm) == 0:
        return 0.0
    inside = _margin(scene, line_mm)
    good = inside >= 0
    middle = int(np.argmin(np.linalg.norm(line_mm - middle_mm, axis=1)))
    if not good[middle]:
        return 0.0
    start = middle - int(np.argmin(np.append(good[middle::-1], False))) + 1
    stop = middle + int(np.argmin(np.append(good[middle:], False)))  # first that is not
    step = float(np.linalg.norm(line_mm[1] - line_mm[0]))
    length = (stop - 1 - start) * step
    for last, beyond in ((start, start - 1), (stop - 1, stop)):
        if 0 <= beyond < len(line_mm) and np.isfinite(inside[beyond]):
            length += step * inside[last] / (inside[last] - inside[beyond])
    return float(length)


def _margin(scene: Scene, line_mm: Floats) -> Floats:
    """(N,) the least share by which points are within the picture and the fan; below 0 outside."""
    pixels = project(scene, sheet_of(scene).in_head(line_mm))
    size = np.array(scene.rig.camera.size_px)
    within = np.minimum(pixels + 0.5, size - 0.5 - pixels) / size
    half = np.radians(scene.tank.laser.fan_half_angle_deg)
    lit = (half - np.abs(fan_angle(scene.tank.laser, line_mm))) / half
    return np.minimum(within.min(axis=1), lit)


# A rig of chosen parts in chosen places, as the document of a scene.


STAND_OFF, BASELINE, HEIGHT = "stand_off_mm", "baseline_mm", "laser_height_mm"
AIM = "aim_z_mm"
DEPRESSION = "head.depression_deg"
FULL_WELL_PER_UM2 = 900.0
"""Electrons, where a camera states no full well: 950 of Sony's IMX249, 880 of its IMX273."""
NOISE_SHARE = 1 / 282
"""Of the full well, where a camera states no dark noise: the webcam's of scenes/paper."""
EFFICIENCY = ((450.0, 0.55), (525.0, 0.65), (650.0, 0.40), (700.0, 0.30))
"""Where a camera states none: estimated; 0.40 at 650 nm is that of scenes/paper."""
BLUR_PX = 0.7  # where a lens states no blur: that of scenes/paper
GREEN_FROM_NM, RED_FROM_NM = 495.0, 580.0
LEAKS = {"red": (1.0, 0.08, 0.03), "green": (0.13, 1.0, 0.16), "blue": (0.03, 0.16, 1.0)}
"""Of a laser's efficiency, by its colour, that of red, green and blue pixels: as in scenes/paper
and in scenes/targets/red-under-green; blue is estimated."""
FOCAL_KNOWN, THICKNESS_KNOWN_MM = 0.05, 0.3
"""Standard uncertainties that [optics] states of a focal length, relative, and of a window."""
PEAK_DN, LONGEST_MS, TRIAL_MS = 200.0, 500.0, 1e-4
BRIGHT_SHARE = 0.95
"""Of a line's columns, that are to stay below the peak's grey value."""


@dataclass(frozen=True)
class RigDesign:
    """Parts, and numbers that say where they stand.

    Attributes
    ----------
    camera, lens, laser, window, track : parts; lens is None where the camera has its own
    numbers : mapping, of free numbers: stand_off_mm, along the camera's axis from the pinhole to
        the sheet; baseline_mm, from the pinhole to the plane y = 0; laser_height_mm, of the
        laser's apex above the place aimed at; aim_z_mm, the height of that place, where the axis
        meets y = 0, the base's if left out; and dotted keys of the scene
    """

    camera: CameraPart
    lens: LensPart | None
    laser: LaserPart
    window: WindowPart
    track: TrackPart
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def cost_eur(self) -> float:
        """What the parts cost together."""
        parts = (self.camera, self.lens, self.laser, self.window, self.track)
        return sum(part.price.eur for part in parts if part is not None)


def document_of(design: RigDesign, base: Document) -> Document:
    """The base's document with the design's parts and numbers in it.

    Parameters
    ----------
    design : RigDesign
    base : Document, of a scene, its board read in; what it says of targets, water, plan stays

    Raises
    ------
    InputError
        The numbers contradict each other, or a key is none of the scene's.
    """
    tank = _tank(base, "the base of the design")
    document = merge(base, _geometry(design, tank))
    document = merge(document, _sight(design, document))
    document = merge(document, _light(design, tank))
    document = merge(document, {"track_errors": design.track.errors.model_dump()})
    for key, value in design.numbers.items():
        if "." in key:
            document = merge(document, _at(key, value, document))
    return merge(document, _stated_by_owner(document))


def with_exposure(document: Document, source: str) -> Document:
    """The document with an exposure that puts the line's brightest parts at PEAK_DN.

    Parameters
    ----------
    document : Document, of a scene with a target that the laser lights
    source : str, what an error names

    Raises
    ------
    InputError
        It is no scene, or no line is lit and seen half-way through the scan.
    """
    scene = scene_of(parse_rig(document, source=source, trusted=True))
    linear = scene.with_tank(sensor={"gamma": 1.0})
    positions = scene.rig.plan.positions_mm()
    truths = stripe_truths(scene, [positions[len(positions) // 2]])
    height = line_brightness(linear, truths, [TRIAL_MS])[0].height_dn
    height = height[np.isfinite(height)]
    if len(height) == 0 or height.max() <= 0:
        raise InputError("no line is lit and seen", where=source)
    wanted_ms = TRIAL_MS * PEAK_DN / float(np.quantile(height, BRIGHT_SHARE))
    return merge(document, {"camera": {"exposure_ms": min(wanted_ms, LONGEST_MS)}})


def _tank(document: Document, source: str) -> TankSections:
    """The tank's sections alone; the whole scene is checked by whoever makes one of it."""
    own = {key: value for key, value in document.items() if key in SECTIONS}
    return check(TankSections, own, where=source)


def _geometry(design: RigDesign, tank: TankSections) -> Document:
    """Where camera and laser stand; the camera turns and moves about the place it aims at."""
    head, numbers, aim = tank.head, design.numbers, aim_mm(tank.head)
    if {STAND_OFF, BASELINE, DEPRESSION} <= numbers.keys():
        what = f"{STAND_OFF}, {BASELINE} and {DEPRESSION}: two of them give the third"
        raise InputError(what, allowed="two of them")
    old = camera_pose(head)
    level = old.rotation[1, 2] / cos(radians(head.depression_deg))  # of the axis, towards y
    depression = numbers.get(DEPRESSION, head.depression_deg)
    stand_off = numbers.get(STAND_OFF, float(np.linalg.norm(aim - old.origin_mm)))
    if BASELINE in numbers and STAND_OFF in numbers:
        part = numbers[BASELINE] / (stand_off * level)
        if not 0 < part <= 1:
            raise InputError(
                f"{BASELINE}: is no leg of {STAND_OFF}", value=numbers[BASELINE],
                allowed=f"up to {stand_off * level:g}",
            )  # fmt: skip
        depression = float(np.degrees(np.arccos(part)))
    elif BASELINE in numbers:
        stand_off = numbers[BASELINE] / (level * cos(radians(depression)))
    aim = np.array([aim[0], aim[1], numbers.get(AIM, aim[2])])
    turned = head.model_copy(update={"depression_deg": depression})
    camera = aim - stand_off * camera_pose(turned).rotation[:, 2]
    height = float(numbers.get(HEIGHT, tank.laser.apex_mm[2] - aim[2]))
    apex = [*tank.laser.apex_mm[:2], float(aim[2] + height)]
    return {
        "head": {"camera_mm": camera.tolist(), "depression_deg": depression},
        # Focused on the place aimed at, as whoever mounts it does.
        "laser": {"apex_mm": apex, "waist_distance_mm": height},
    }


def _sight(design: RigDesign, document: Document) -> Document:
    """Camera, lens and window."""
    camera, nm = design.camera, design.laser.wavelength_nm
    objective: Objective | None = design.lens or camera.built_in
    if objective is None or (design.lens is not None and not design.lens.fits(camera)):
        raise InputError(f"{camera.name}: needs a lens that fits it")
    width, height = camera.width_px, camera.height_px
    if objective.focal_mm is not None:
        focal_px = objective.focal_mm * 1e3 / camera.pixel_um
    else:
        focal_px = hypot(width, height) / 2 / tan(radians(objective.diagonal_deg or 0.0) / 2)
    f_number = design.numbers.get("lens.f_number", objective.f_number)
    diffraction_px = diffraction_um(f_number, nm) / camera.pixel_um
    own_px = BLUR_PX if objective.blur_um is None else objective.blur_um / camera.pixel_um
    full_well = camera.full_well_e or FULL_WELL_PER_UM2 * camera.pixel_um**2
    colour, response = response_to(camera, nm)
    window = {"thickness_mm": design.window.thickness_mm, "glass_index": design.window.glass_index}
    dome = document.get("port", {}).get("kind") == "dome"
    return {
        "camera": {"width_px": width, "height_px": height},
        "lens": {
            "focal_px": focal_px,
            "centre_px": [(width - 1) / 2, (height - 1) / 2],
            **dict.fromkeys(("k3", "p1", "p2"), 0.0),
            "k1": objective.k1,
            "k2": objective.k2,
            "f_number": f_number,
            "blur_px": hypot(diffraction_px, own_px),
        },
        "port": {"kind": "flat", **window} if dome else window,
        "sensor": {
            "pixel_um": camera.pixel_um,
            "full_well_e": full_well,
            "dark_noise_e": camera.dark_noise_e or NOISE_SHARE * full_well,
            "bayer": "RGGB" if camera.colour else "none",
            "readout_ms": camera.readout_ms,
            "laser_response": response.model_dump(),
        },
        # Also of a camera without colours: the grey of three equal channels, whose noise is
        # each its own, would be less noisy than its pixels are.
        "stripe": {"channel": colour},
    }


def diffraction_um(f_number: float, wavelength_nm: float) -> float:
    """Standard deviation of the Gaussian that is nearest to Airy's pattern, um.

    Parameters
    ----------
    f_number : float
    wavelength_nm : float

    References
    ----------
    Zhang, Zerubia & Olivo-Marin, Applied Optics 46, 1819 (2007): sqrt(2) / (k NA), the numerical
    aperture NA = 1 / (2 f_number).
    """
    return sqrt(2) * 2 * f_number * wavelength_nm * 1e-3 / (2 * pi)


def response_to(camera: CameraPart, wavelength_nm: float) -> tuple[str, Response]:
    """The channel that sees a laser's light best, and all channels' quantum efficiency.

    Parameters
    ----------
    camera : CameraPart
    wavelength_nm : float
    """
    if wavelength_nm >= RED_FROM_NM:
        colour = "red"
    else:
        colour = "green" if wavelength_nm >= GREEN_FROM_NM else "blue"
    nm, share = np.transpose(camera.efficiency or EFFICIENCY)
    efficiency = float(np.interp(wavelength_nm, nm, share))
    leaks = LEAKS[colour] if camera.colour else (1.0, 1.0, 1.0)
    red, green, blue = (efficiency * leak for leak in leaks)
    return colour, Response(red=red, green=green, blue=blue)


def _light(design: RigDesign, tank: TankSections) -> Document:
    part = design.laser
    if tank.laser.lines:
        raise InputError("laser.lines: the laser of a design has one sheet")
    return {
        "laser": {
            "power_mw": part.power_mw,
            "wavelength_nm": part.wavelength_nm,
            "fan_half_angle_deg": part.fan_deg / 2,
            "fan": part.fan,
            "fan_rise": 0.0,
            "waist_mm": part.waist_mm,
        }
    }


def _at(key: str, value: float, document: Document) -> Document:
    """A document with one number at a dotted key, whose section is there already."""
    section, _, name = key.partition(".")
    if not isinstance(document.get(section), dict) or not name or "." in name:
        raise InputError(f"{key}: cannot be a free number", allowed="section.key of the scene")
    return {section: {name: value}}


def _stated_by_owner(document: Document) -> Document:
    """What the rig's owner states of it, where the base states it: it is made to agree."""
    tank = _tank(document, "the design")
    told = {"lens": {"focus_mm": apparent_mm(tank)}, **stated_of_light(document)}
    if "optics" in document:
        told["optics"] = _optics(tank, document["optics"])
    return told


def stated_of_light(document: Document) -> Document:
    """What [stripe] and [sheet] state of lens, sensor and laser, made to agree with the tank's.

    Parameters
    ----------
    document : Document, of a scene; of these sections, what it does not state is left out
    """
    tank = _tank(document, "the design")
    lens, laser, sensor = tank.lens, tank.laser, tank.sensor
    told: dict[str, Any] = {}
    stripe = document.get("stripe", {})
    if "blur_px" in stripe:
        told["stripe"] = {"blur_px": lens.blur_px}
    if "noise" in stripe:
        gain = FULL_SCALE_DN * sensor.gain / sensor.full_well_e
        speckle = 0.0
        if sensor.speckle != "none":
            speckle = speckle_contrast(
                sensor.pixel_um, lens.f_number, laser.wavelength_nm, sensor.speckle
            )
        step_dn = 2.0 ** (8 - document["camera"].get("bits", 8))
        read_dn = hypot(gain * hypot(sensor.dark_noise_e, sensor.dsnu_e), step_dn / sqrt(12))
        noise = {"read_dn": read_dn, "dn_per_electron": gain, "speckle": speckle}
        told.setdefault("stripe", {})["noise"] = noise
    if "sheet" in document:
        told["sheet"] = {
            "thickness_mm": laser.waist_mm,
            "camera_mm": list(tank.head.camera_mm),
            "apex_mm": list(laser.apex_mm),
        }
    return told


def apparent_mm(tank: TankSections) -> float:
    """How far off the place aimed at appears, mm of air: where whoever mounts a lens focuses it.

    Parameters
    ----------
    tank : TankSections, its port flat
    """
    nm, port = tank.laser.wavelength_nm, tank.port
    if not isinstance(port, PlanePort):
        raise InputError("port: the window of a design is flat")
    far = float(np.linalg.norm(aim_mm(tank.head) - np.array(tank.head.camera_mm)))
    water = far - port.gap_mm - port.thickness_mm
    if water <= 0:
        raise InputError(f"{STAND_OFF}: the place aimed at is not in the water", value=far)
    glass = port.thickness_mm / glass_index(port.glass_index, nm)
    return port.gap_mm + glass + water / water_optics(tank.water, nm).index


def _optics(tank: TankSections, stated: Document) -> Document:
    """[optics] of the same keys, its numbers those of the tank."""
    true = true_optics(tank)
    known = {"focal_px": FOCAL_KNOWN * true["focal_px"], "thickness_mm": THICKNESS_KNOWN_MM}
    told: Document = {
        key: [true[key], known[key] if key in known else stated[key][1]]
        for key in ("focal_px", "thickness_mm", "glass_index", "water_index")
        if key in stated
    }
    return told | {key: true[key] for key in ("wavelength_nm",) if key in stated}


def true_optics(tank: TankSections) -> dict[str, float]:
    """What [optics] may state of lens, port and water, as it truly is, by its keys.

    Parameters
    ----------
    tank : TankSections
    """
    lens, nm = tank.lens, tank.laser.wavelength_nm
    port = {key: value for key, value in tank.port if key in ("gap_mm", "thickness_mm")}
    centre_u, centre_v = lens.centre_px
    return {
        **{key: getattr(lens, key) for key in ("focal_px", "k1", "k2", "p1", "p2")},
        "centre_u_px": centre_u,
        "centre_v_px": centre_v,
        **port,
        "glass_index": glass_index(tank.port.glass_index, nm),
        "water_index": water_optics(tank.water, nm).index,
        "temperature_c": tank.water.temperature_c,
        "salinity_psu": tank.water.salinity_psu,
        "wavelength_nm": nm,
    }
