"""Maps carried to other water, and to a rig that has changed since the calibration.

A calibration is made in fresh water of 20 C; then the same rig, in other water or changed as far as
it is stated to be uncertain, sees points of the sheet.  How far their mapped places are from the
true ones, and how often that is within the stated intervals, is what the rows say.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from lscan.calibration.check import map_for_rig
from lscan.calibration.physical import PhysicalMap
from lscan.config.rig import OpticsSection, Rig, SinceSection
from lscan.records import Floats
from lscan.water import refractive_index
from sim.datasets.files import held_scenes
from sim.scene import Pose, Scene, camera_pose, load_scene
from sim.truth import project, sheet_of
from tests.validation.exposures import band_miss_percent, share_inside
from tests.validation.rows import Row, row
from tests.validation.surfaces.drawn import (
    FieldEffort,
    drawn_rig,
    metric_frame,
    metric_map,
    refractive_map,
)

# Temperature in C, salinity in psu, depth in m, and their standard uncertainties as measured with a
# thermometer, a conductivity meter and a pressure gauge of the simplest kind.
CALIBRATED = (20.0, 0.0, 0.0)
WATERS = (
    (2.0, 0.0, 0.0), (8.0, 0.0, 0.0), (14.0, 0.0, 10.0), (28.0, 0.0, 0.0),
    (2.0, 17.0, 0.0), (5.0, 33.0, 0.0), (10.0, 32.0, 20.0), (15.0, 10.0, 5.0),
    (20.0, 33.0, 0.0), (25.0, 33.0, 50.0), (28.0, 5.0, 0.0), (12.0, 33.0, 50.0),
)  # fmt: skip
SIGMAS = (0.5, 0.5, 1.0)
LOWEST, HIGHEST = (0.0, 0.0, 0.0), (30.0, 35.0, 100.0)
RIGS = 10  # drawn for each seed; the errors of one rig are nearly one, so it takes many
WATERS_EACH = 3  # of WATERS that each rig is taken to, in turn
CHANGES_EACH = 2  # of SINCE that each rig undergoes, in turn
DRAWS = 3  # of each change
VIEWS = 8  # of the hand board
STEP_MM = 50.0  # of the grid of places that are looked at

# What may have changed, each kind by itself and all together: typical of a rig that was carried.
SHIFT, TILT, CAMERA, FOCAL, PORT, INDEX = (
    {"sheet_shift_mm": 0.5},
    {"sheet_tilt_deg": 0.1},
    {"camera_tilt_deg": 0.05},
    {"focal_percent": 0.1},
    {"port_tilt_deg": 0.5},
    {"water_index": 0.0002},  # 2 degrees, or 1 psu
)
SINCE = (
    SHIFT, TILT, CAMERA, FOCAL, PORT, INDEX,
    SHIFT | TILT, CAMERA | FOCAL, PORT | INDEX,
    SHIFT | TILT | CAMERA | FOCAL | PORT | INDEX,
)  # fmt: skip


@dataclass(frozen=True)
class DrawnRig:
    """A rig, its map, and the frame in which the map reads the points of the head."""

    scene: Scene
    plane_map: PhysicalMap
    frame: Pose

    @property
    def middle_mm(self) -> Floats:
        """(3,) head frame, mm, the middle of what was calibrated."""
        x, z = self.plane_map.geometry.at_mm
        return self.frame.apply(np.array([x, 0.0, z]))


@dataclass(frozen=True)
class PlaceErrors:
    """Errors of N places as R rigs see them, mm, and their standard uncertainties, (R, N, 2).

    NaN where a map does not cover the place.
    """

    error_mm: Floats
    sigma_mm: Floats

    @property
    def share_inside(self) -> float:
        """Share of the coordinates that lie within their 95 % intervals."""
        known = np.isfinite(self.error_mm)
        return share_inside(self.error_mm[known], self.sigma_mm[known])

    @property
    def bias_mm(self) -> float:
        """Rms over places of the mean error of all rigs, less what their scatter adds to it.

        The square of a mean of R values exceeds that of the expectation by their variance over R;
        of one rig alone the scatter is not known.
        """
        seen = np.isfinite(self.error_mm[..., 0]).sum(axis=0)
        places = np.flatnonzero(seen > (1 if seen.max() > 1 else 0))
        errors, count = self.error_mm[:, places], seen[places, None]
        mean = np.nanmean(errors, axis=0)
        scatter = np.nanmean((errors - mean) ** 2, axis=0) / np.maximum(count - 1, 1)
        return float(np.sqrt(max(np.mean(mean**2 - scatter), 0.0)))


def water_rows(scenes: Path, effort: FieldEffort, name: str) -> list[Row]:
    """Bias and intervals of a map in other water, and intervals on changed rigs.

    scenes: holds paper/board and metric/water.  name: "refractive" or "metric".
    """
    rigs = list({"refractive": refractive_rigs, "metric": metric_rigs}[name](scenes, effort))
    return [*_in_other_water(name, rigs, effort), _on_changed_rigs(name, rigs, effort)]


def refractive_rigs(scenes: Path, effort: FieldEffort) -> Iterator[DrawnRig]:
    """Rigs calibrated from one picture of the paper's board in the sheet."""
    for scene, generator in _drawn(load_scene(scenes / "paper" / "board.toml"), effort):
        solved = refractive_map(scene, scene.rig.optics, generator)
        yield DrawnRig(scene, solved, Pose(np.eye(3), np.zeros(3)))


def metric_rigs(scenes: Path, effort: FieldEffort) -> Iterator[DrawnRig]:
    """Rigs calibrated from views of a hand board; the sheet leans against the head."""
    nominal = load_scene(scenes / "metric" / "water.toml")
    held = held_scenes(nominal, VIEWS)
    for scene, generator in _drawn(nominal, effort):
        solved = metric_map(scene, held, scene.rig.optics, generator)
        yield DrawnRig(scene, solved, metric_frame(scene))


def _drawn(nominal: Scene, effort: FieldEffort) -> Iterator[tuple[Scene, np.random.Generator]]:
    """Rigs in the water of the calibration, as far off as it is stated to be, and their noise."""
    stated = _stating(nominal, CALIBRATED)
    for seed in effort.seeds:
        for number in range(1 if effort.plain else RIGS):
            generator = np.random.default_rng([seed, number])
            yield _in_water(drawn_rig(stated, generator), CALIBRATED, generator), generator


def _in_other_water(name: str, rigs: list[DrawnRig], effort: FieldEffort) -> Iterator[Row]:
    """Largest bias in one of the waters, with the map carried and as it is; and the intervals."""
    generator = np.random.default_rng([effort.seeds[0], 1])
    moved, left = [], []
    for place, water in enumerate(WATERS):
        found = []
        for rig in rigs[place % (len(WATERS) // WATERS_EACH) :: len(WATERS) // WATERS_EACH]:
            there = _in_water(rig.scene, water, generator)
            found.append(
                (_errors(there, rig, _stating(there, water).rig), _errors(there, rig, None))
            )
        if found:
            carried_, as_it_is = zip(*found, strict=True)
            moved.append(_together(carried_))
            left.append(_together(as_it_is))
    bias, uncarried = (max(errors.bias_mm for errors in each) for each in (moved, left))
    words: dict[str, Any] = {"name": name, "rigs": len(rigs), "waters": len(moved)}
    words["seed"] = effort.seeds[0]
    share = _together(moved).share_inside
    yield row("water-bias", bias, uncarried=uncarried, **words)
    yield row("water-intervals", band_miss_percent(share), percent=100 * share, **words)


def _on_changed_rigs(name: str, rigs: list[DrawnRig], effort: FieldEffort) -> Row:
    """How far the share of errors within their intervals is from 94 %, the middle of the bar's."""
    generator = np.random.default_rng([effort.seeds[0], 2])
    every = []
    for place, changes in enumerate(SINCE):
        since = SinceSection(**changes)
        found = []
        for rig in rigs[place % (len(SINCE) // CHANGES_EACH) :: len(SINCE) // CHANGES_EACH]:
            stated = rig.scene.rig.model_copy(update={"since_calibration": since})
            for _ in range(1 if effort.plain else DRAWS):
                there = _changed(rig.scene, since, rig.middle_mm, generator)
                found.append(_errors(there, rig, stated))
        if found:
            every.append(_together(found))
    shares = [100 * errors.share_inside for errors in every]
    percent = 100 * _together(every).share_inside
    return row(
        "since-intervals", abs(percent - 94), seed=effort.seeds[0], name=name, percent=percent,
        least=min(shares), most=max(shares), rigs=len(rigs), changes=len(shares),
    )  # fmt: skip


def _errors(there: Scene, rig: DrawnRig, stated: Rig | None) -> PlaceErrors:
    """Errors of all places, seen by the rig as it is now.

    stated: the rig of the scan, to which the map is carried; None: the map as it is.
    """
    head = _places(there)
    plane_map = rig.plane_map if stated is None else map_for_rig(rig.plane_map, stated)
    points = plane_map.to_plane(project(there, head))
    true = rig.frame.invert(head)[:, [0, 2]]
    return PlaceErrors((points.xz_mm - true)[None], points.sigma_mm[None])


def _places(scene: Scene) -> Floats:
    """(N, 3) head frame, mm, places all over the part of the sheet that a picture shows."""
    across, up = np.arange(25.0, 426.0, STEP_MM), np.arange(-425.0, -24.0, STEP_MM)
    x, z = np.meshgrid(across, up)
    return sheet_of(scene).in_head(np.column_stack([x.ravel(), z.ravel()]))


def _together(parts: Sequence[PlaceErrors]) -> PlaceErrors:
    return PlaceErrors(
        np.concatenate([part.error_mm for part in parts]),
        np.concatenate([part.sigma_mm for part in parts]),
    )


def _stating(scene: Scene, water: tuple[float, float, float]) -> Scene:
    """The scene whose rig states that water, with SIGMAS."""
    names = ("temperature_c", "salinity_psu", "depth_m")
    known = dict(zip(names, zip(water, SIGMAS, strict=True), strict=True))
    optics = scene.rig.optics.model_dump(exclude_unset=True) | known
    optics.pop("water_index", None)
    rig = scene.rig.model_copy(update={"optics": OpticsSection.model_validate(optics)})
    return replace(scene, rig=rig)


def _in_water(
    scene: Scene, water: tuple[float, float, float], generator: np.random.Generator
) -> Scene:
    """The scene in that water, as far off as SIGMAS say it may be."""
    state = np.clip(generator.normal(water, SIGMAS), LOWEST, HIGHEST)
    return scene.with_tank(
        water={
            "temperature_c": float(state[0]),
            "salinity_psu": float(state[1]),
            "pressure_mpa": 0.101325 + 0.0101 * float(state[2]),
        }
    )


def _changed(
    scene: Scene, since: SinceSection, middle_mm: Floats, generator: np.random.Generator
) -> Scene:
    """The scene with changes drawn from their standard uncertainties.

    middle_mm: (3,) head frame, about which the sheet is tilted.
    """
    tank = scene.tank

    def off(sigma: float) -> float:
        return float(generator.normal(0.0, sigma))

    tilted = scene.with_tank(
        laser={
            "tilt_deg": tank.laser.tilt_deg + off(since.sheet_tilt_deg),
            "skew_deg": tank.laser.skew_deg + off(since.sheet_tilt_deg),
        }
    )
    (was, now), (x, y, z) = (sheet_of(scene).pose, sheet_of(tilted).pose), tank.laser.apex_mm
    back = (now.invert(middle_mm)[1] - was.invert(middle_mm)[1]) / now.rotation[1, 1]
    turn = Rotation.from_rotvec(np.radians(generator.normal(0.0, since.camera_tilt_deg, 3)))
    head = Rotation.from_matrix(camera_pose(tank.head).rotation) * turn
    heading, depression, roll = head.as_euler("ZXZ", degrees=True)  # the second above 0
    port = {
        name: getattr(tank.port, name) + off(since.port_tilt_deg)
        for name in ("tilt_x_deg", "tilt_y_deg")
    }
    return tilted.with_tank(
        laser={"apex_mm": (x, y + back + off(since.sheet_shift_mm), z)},
        head={
            "heading_deg": heading - 180,
            "depression_deg": depression - 90,
            "roll_deg": roll - 180,
        },
        port=port,
        lens={"focal_px": tank.lens.focal_px * (1 + off(since.focal_percent) / 100)},
        water=_with_index_off(scene, off(since.water_index)),
    )


def _with_index_off(scene: Scene, change: float) -> dict[str, float]:
    """The state of fresh water whose index is that much another: saltier, or warmer."""
    water, nm = scene.tank.water, scene.tank.laser.wavelength_nm
    name, most = ("salinity_psu", 35.0) if change > 0 else ("temperature_c", 30.0)
    state = {"temperature_c": water.temperature_c, "salinity_psu": water.salinity_psu}
    wanted = refractive_index(**state, wavelength_nm=nm) + change

    def missed(value: float) -> float:
        return refractive_index(**(state | {name: value}), wavelength_nm=nm) - wanted

    return {name: float(brentq(missed, state[name], most))}
