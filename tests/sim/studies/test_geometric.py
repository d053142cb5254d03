"""The geometric tier: errors of rigs in closed form, and which state knows of which cause."""

from dataclasses import replace

import numpy as np
import pytest
from study_cases import known_of, study_with

from lscan.calibration.planemap import find_solver
from lscan.config.documents import Document, merge
from lscan.config.rig import parse_rig
from lscan.errors import BoardNotFound, InputError, MeasurementError
from lscan.records import Floats
from sim.scene import into_head, scene_of
from sim.studies.problem import NOMINAL, columns
from sim.studies.rig.evaluation import ErrorFrame, GeometricRig
from sim.studies.rig.states import WAVE, check_keys, states_of
from sim.truth import project
from tests.validation.studies.twelve import SENSOR_PX, SPECKLE_PX, assumed

BASE_MM = 1e-3
"""What is left with nothing at work: the screen of outliers and the search of the map stop at
relative changes of 1e-8 and less; of 1 m that is 0.01 um, and of a far ray's lever ten times that.
The nominal rig's own priors ([optics], which say 830 px and 11 mm) leave 0.3 um."""


def errors(cause: Document, **sections: object) -> dict[str, Floats]:
    """Errors with one cause at work, at the middle of its distribution."""
    rig = GeometricRig(study_with({"one": cause}, **sections), known_of())
    found = rig.evaluate(np.array([0.5]))
    return {name: found[part] for name, part in columns(rig.outputs).items()}


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_with_nothing_at_work_nothing_is_off() -> None:
    rig = GeometricRig(
        study_with({"one": {"key": "lens.focal_px", "when": "drift", "fixed": 851.0}}), known_of()
    )
    assert np.abs(rig.evaluate(np.full(len(rig.causes), NOMINAL))).max() < BASE_MM


@pytest.mark.parametrize(
    "target",
    [{"position_mm": [0.0, 0.0, 92.0]}, {"position_mm": [-25.0, 0.0, 10.0], "tilt_y_deg": 3.0}],
    ids=["above", "beside and turned"],
)
def test_where_the_board_lies_in_the_sheet_does_not_matter(target: Document) -> None:
    """A board elsewhere in the sheet defines another frame to measure from, and no error.

    One that a cause lays 1 mm higher than it is taken to lie measures all 1 mm too low.
    """
    off = {"key": "calibrate.target.position_mm.2", "when": "as-built", "fixed": 1.0, "off": True}
    study = study_with({"one": off})
    document = merge(study.calibrate.document, {"target": target})
    board = scene_of(parse_rig(document, source="board.toml", trusted=True))
    study = replace(study, calibrate=board)
    rig = GeometricRig(study, assumed(study, known_of().places))
    height = columns(rig.outputs)["height"]
    assert np.abs(rig.evaluate(np.array([NOMINAL]))[height]).max() < BASE_MM
    level = rig.prepared.places.kind != WAVE
    np.testing.assert_allclose(rig.evaluate(np.array([0.5]))[height][level], -1.0, atol=BASE_MM)


def test_a_board_behind_the_sheet_lifts_the_line_by_its_depression() -> None:
    """What the map takes for a point of the board's plane is where its ray meets the sheet.

    A ray that falls by t for each mm towards +y meets a plane shifted by d lower by t d: the
    height found is the true one less that.  On level places only; the rays' slopes in the water
    are taken as those from the pinhole itself, which lies within 16 mm, the port's depth, of where
    they enter the water, of a way of 1 m: good to some 16/1000.
    """
    shift_mm = 1.0
    found = errors({"key": "calibrate.target.position_mm.1", "when": "as-built", "fixed": shift_mm})
    study, places = (
        study_with({"one": {"key": "lens.focal_px", "when": "drift", "fixed": 850.0}}),
        (known_of().places),
    )
    head = into_head(study.scan.tank.head, places.world_mm, places.position_mm)
    from_camera = head - np.array(study.scan.tank.head.camera_mm)
    expected = shift_mm * from_camera[:, 2] / from_camera[:, 1]
    level = places.kind != WAVE
    assert level.sum() >= 3
    np.testing.assert_allclose(found["height"][level], expected[level], rtol=0.016)


@pytest.mark.parametrize(
    "cause",
    [
        {"key": "port.tilt_x_deg", "fixed": 1.0},
        {"key": "lens.focal_px", "fixed": 1e-3, "relative": True},
        {"key": "laser.apex_mm.1", "fixed": 1.0},
    ],
    ids=lambda cause: cause["key"],
)
def test_calibrating_anew_takes_away_what_the_board_shows(cause: Document) -> None:
    """The board stands in the sheet as it lies then, and what is measured is measured from there.

    What is left is what the map's form cannot follow: a micrometre or two for a port tilted by a
    degree, which has no parameter of its own in the map.
    """
    found = errors({**cause, "when": "drift"})
    assert rms(found["height"]) > 0.1
    assert rms(found["height.after"]) < 2 * BASE_MM


def test_what_recalibrating_does_not_see_stays() -> None:
    """A board that leans against the sheet leans again."""
    lean = {"key": "calibrate.target.tilt_x_deg", "when": "as-built", "fixed": 0.5}
    port = {"key": "port.tilt_x_deg", "when": "drift", "fixed": 0.5}
    rig = GeometricRig(study_with({"lean": lean, "port": port}), known_of())
    parts = columns(rig.outputs)
    both, leaning = (rig.evaluate(np.array([0.5, other])) for other in (0.5, np.nan))
    assert rms(both[parts["height"]]) > 1.2 * rms(leaning[parts["height"]])
    after = both[parts["height.after"]]
    np.testing.assert_allclose(after, leaning[parts["height"]], atol=0.02)


def test_what_is_built_in_is_calibrated_away() -> None:
    found = errors({"key": "port.tilt_x_deg", "when": "as-built", "fixed": 1.0})
    assert rms(found["height"]) < 2 * BASE_MM
    assert "height.after" not in found


def test_a_track_that_is_too_long_measures_too_short() -> None:
    """1000 ppm are 0.1 mm of 100 mm; the points lie where the track was told to go."""
    found = errors({"key": "track_errors.scale_ppm", "when": "as-built", "fixed": 1000.0})
    assert found["length-along"][0] == pytest.approx(-0.1, rel=0.01)


def test_noise_scatters_as_it_was_found() -> None:
    """Over many seeds: the mean square of the errors is that of the line's scatter, by the map."""
    study = study_with(
        {
            "sensor": {"key": "sensor.noise", "when": "noise"},
            "speckle": {"key": "sensor.speckle", "when": "noise"},
        }
    )
    rig, known = GeometricRig(study, known_of()), known_of()
    quiet = GeometricRig(study, replace(known, marks_sigma_px=0 * known.marks_sigma_px))
    height = columns(rig.outputs)["height"]
    rows = np.random.default_rng(1).random((20, 1)).repeat(2, axis=1)  # apart, of one number
    found = np.stack([quiet.evaluate(row)[height] for row in rows])
    # Of one pixel across: a difference of the map.
    head = into_head(study.scan.tank.head, known.places.world_mm, known.places.position_mm)
    pixels = project(study.scan, head)
    solved = find_solver("refractive").solve(known.reading, study.calibrate.rig.optics)
    step = (
        solved.to_plane(pixels + np.array([0, 0.5])).xz_mm
        - solved.to_plane(pixels - np.array([0, 0.5])).xz_mm
    )
    expected = np.hypot(SENSOR_PX, SPECKLE_PX) * rms(step[:, 1])
    # 20 rigs of 60 places scatter by 1/sqrt(2 * 1200) = 2 %; slopes of the wave by a few more.
    assert rms(found) == pytest.approx(expected, rel=0.07)
    # The marks' scatter moves the map, all points of one rig together.
    moved = np.stack([rig.evaluate(row)[height] for row in rows[:5]]) - found[:5]
    assert 0 < rms(moved) < 0.2 * expected


def test_the_same_row_gives_the_same_bytes() -> None:
    study = study_with(
        {
            "shake": {"key": "head.depression_deg", "when": "each-frame", "normal": (0.0, 0.01)},
            "sensor": {"key": "sensor.noise", "when": "noise"},
            "salt": {"key": "water.salinity_psu", "when": "drift", "uniform": (0.0, 35.0)},
        }
    )
    row = np.array([0.3, 0.6, 0.2])
    first, second = (GeometricRig(study, known_of()).evaluate(row) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    other = GeometricRig(study, known_of()).evaluate(np.array([0.31, 0.6, 0.2]))
    assert not np.array_equal(first, other)


# ---- states ---------------------------------------------------------------------------------


def test_each_state_knows_of_its_causes() -> None:
    study = study_with(
        {
            "gap": {"key": "port.gap_mm", "when": "as-built", "normal": (10.0, 1.0)},
            "salt": {"key": "water.salinity_psu", "when": "drift", "uniform": (0.0, 35.0)},
            "shake": {"key": "laser.tilt_deg", "when": "each-frame", "uniform": (-0.1, 0.1)},
            "board": {"key": "calibrate.target.tilt_x_deg", "when": "as-built", "fixed": 0.5},
            "screw": {
                "key": "track_errors.periodic_mm", "when": "as-built", "fixed": 0.05,
                "with": {"track_errors.pitch_mm": 4.0},
            },
        }
    )  # fmt: skip
    states = states_of(study, np.array([0.5, 0.2, 0.5, 0.5, 0.5]))
    assert states.recalibrate is not None
    salts = [s.tank.water.salinity_psu for s in (states.calibrate, states.recalibrate, states.scan)]
    assert salts == [0.0, 7.0, 7.0]
    assert states.calibrate.tank.port == states.scan.tank.port
    assert (
        states.calibrate.tank.target.tilt_x_deg == states.recalibrate.tank.target.tilt_x_deg == 0.5
    )
    assert states.scan.tank.target == study.scan.tank.target
    assert [change.key for change in states.scan.tank.change] == ["laser.tilt_deg"]
    assert not states.calibrate.tank.change
    assert states.scan.tank.track_errors.pitch_mm == 4.0
    nothing = states_of(study, np.full(5, np.nan))
    assert nothing.scan is study.scan and nothing.recalibrate is None


@pytest.mark.parametrize(
    ("cause", "words"),
    [
        ({"key": "water.salt", "when": "drift", "fixed": 1.0}, r"cause.one.*water.salt.*salinity"),
        ({"key": "water.salinity_psu", "when": "drift", "fixed": 36.0}, r"cause.one.*36"),
        ({"key": "lens.k1", "when": "each-frame", "normal": (0.0, 1.0)}, r"cause.one.*lens.k1"),
    ],
)
def test_a_key_that_cannot_vary_is_refused_by_name(cause: Document, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_keys(study_with({"one": cause}))


@pytest.mark.parametrize(
    ("cause", "words"),
    [
        ({"key": "sensor.noise", "when": "noise", "fixed": 1.0}, "takes no distribution"),
        ({"key": "lens.k1", "when": "each-frame", "normal": (1.0, 1.0)}, "is about 0"),
        (
            {"key": "lens.k1", "when": "drift", "fixed": 1.0, "off": True, "relative": True},
            "exclude",
        ),
    ],
)
def test_a_cause_that_says_nothing_sound_is_refused(cause: Document, words: str) -> None:
    with pytest.raises(InputError, match=words):
        study_with({"one": cause})


def test_correlated_causes_are_in_one_group() -> None:
    gap = {"key": "port.gap_mm", "when": "as-built", "normal": (10.0, 1.0)}
    glass = {"key": "port.thickness_mm", "when": "as-built", "normal": (6.0, 0.5)}
    together = [{"between": ["gap", "glass"], "by": 0.8}]
    with pytest.raises(InputError, match="must be in one group"):
        study_with({"gap": gap, "glass": glass}, correlation=together)
    grouped = {name: {**one, "group": "port"} for name, one in (("gap", gap), ("glass", glass))}
    study = study_with(grouped, correlation=together)
    assert study.groups == {"port": ("gap", "glass")}
    rows = np.random.default_rng(1).random((1000, 2))
    root = study.correlation_root()
    drawn = [states_of(study, row, root).scan.tank.port for row in rows]
    gaps, glasses = ([getattr(port, name) for port in drawn] for name in ("gap_mm", "thickness_mm"))
    # (1 - r^2) / sqrt(1000) is its standard error.
    assert np.corrcoef(gaps, glasses)[0, 1] == pytest.approx(0.8, abs=4 * 0.36 / 1000**0.5)


def test_a_board_behind_the_camera_is_not_found() -> None:
    """3 m nearer than the sheet: no mark has a place in the picture."""
    with pytest.raises(BoardNotFound, match="found 0"):
        errors({"key": "calibrate.target.position_mm.1", "when": "as-built", "fixed": -3000.0})


def test_correlations_that_no_numbers_have_are_refused() -> None:
    """0.6 * 0.8 + sqrt(1 - 0.6^2) sqrt(1 - 0.8^2) = 0.96 is the most: its matrix has no root."""
    gap = {"key": "port.gap_mm", "when": "as-built", "normal": (10.0, 1.0), "group": "port"}
    pairs = {("a", "b"): 0.6, ("b", "c"): 0.8, ("a", "c"): 0.97}
    together = [{"between": list(pair), "by": by} for pair, by in pairs.items()]
    with pytest.raises(InputError, match="do not contradict each other"):
        study_with(dict.fromkeys("abc", gap), correlation=together)


# ---- errors ---------------------------------------------------------------------------------


def test_a_plane_is_levelled_away_and_its_numbers_are_found() -> None:
    rng = np.random.default_rng(3)
    world = np.column_stack(
        [rng.uniform(0, 300, 50), rng.uniform(0, 200, 50), rng.normal(0, 5, 50)]
    )
    frame, middle = ErrorFrame(world), world.mean(axis=0)
    off = world - middle
    height = 0.3 + np.tan(np.radians(0.1)) * off[:, 0] - np.tan(np.radians(0.2)) * off[:, 1]
    turn = np.radians(0.05)
    measured = world + np.column_stack(
        [1e-3 * off[:, 0] - turn * off[:, 1], 2e-3 * off[:, 1] + turn * off[:, 0], 0 * height]
    )
    found = frame.errors_of(measured, world, height)
    values = {name: found[part] for name, part in columns(frame.outputs).items()}
    assert np.abs(values["levelled"]).max() < 1e-12
    expected = {"level": 0.3, "tilt-across": 0.1, "tilt-along": -0.2, "length-across": 0.1,
                "length-along": 0.2, "turn": 0.05}  # fmt: skip
    assert {name: values[name][0] for name in expected} == pytest.approx(expected)


def test_sizes_of_a_scans_normal_errors_are_their_deviation_and_its_quantile() -> None:
    rng, count, sigma_mm = np.random.default_rng(5), 20_000, 0.2
    world = np.column_stack([rng.uniform(0, 300, (count, 2)), np.zeros(count)])
    frame = ErrorFrame(world)
    found = frame.errors_of(world, world, 3.0 + rng.normal(0, sigma_mm, count))
    values = {name: found[part] for name, part in columns(frame.outputs).items()}
    # Standard errors: sigma / sqrt(2 n), and of a quantile q sqrt(q (1 - q) / n) over the density
    # there, of both sides: 0.0289; four of them.
    assert values["levelled-rms"][0] == pytest.approx(sigma_mm, abs=4 * 0.005 * sigma_mm)
    error = np.sqrt(0.99 * 0.01 / count) / 0.0289
    assert values["levelled-99"][0] == pytest.approx(2.5758 * sigma_mm, abs=4 * error * sigma_mm)


def test_a_rig_that_loses_its_places_has_no_errors() -> None:
    frame = ErrorFrame(known_of().places.world_mm)
    measured = frame.world_mm.copy()
    height = np.zeros(len(measured))
    height[: len(height) // 4] = np.nan
    with pytest.raises(MeasurementError, match="beside the board"):
        frame.errors_of(measured, frame.world_mm, height)
