"""Maps carried to other water, and to a rig that has changed, against views of that rig."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise
from planeviews import EXACT_BOARD, View, paper_board, read_board
from scipy.spatial.transform import Rotation

from lscan.calibration.calibrate import calibrate
from lscan.calibration.calibrationfile import load_plane_map, save_calibration
from lscan.calibration.check import kept_for_want_of_water, map_for_rig
from lscan.calibration.maps.refractive import Refractive
from lscan.calibration.metric.planemap import Metric
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.physical import PhysicalMap
from lscan.calibration.planemap import find_solver
from lscan.camera import project
from lscan.config.rig import CameraSection, OpticsSection, Rig, SinceSection, TrackSection
from lscan.errors import InputError
from lscan.records import Floats, Status
from lscan.water import refractive_index

BOARD = paper_board()
LENS = {
    "focal_px": (850.0, 0.0),
    "centre_u_px": (319.5, 0.0),
    "centre_v_px": (239.5, 0.0),
    "k1": (-0.22, 0.0),
    "k2": (0.06, 0.0),
    "p1": (0.0, 0.0),
    "p2": (0.0, 0.0),
    "gap_mm": (10.0, 0.0),
    "thickness_mm": (6.0, 0.0),
    "glass_index": (1.49, 0.0),
    "tilt_x_deg": (0.0, 0.0),
    "tilt_y_deg": (0.0, 0.0),
}
VIEW = View(n_water=refractive_index(20.0, 0.0, 650.0))
POINTS = np.array([[50.0, -50.0], [225, -200], [300, -300], [100, -350], [400, -100]])
TEMPERATURES, SALINITIES = st.floats(0, 30), st.floats(0, 35)


def in_water(temperature_c: float, salinity_psu: float, **known: tuple[float, float]) -> Rig:
    """A rig whose [optics] states this water, exactly."""
    state = {"temperature_c": (temperature_c, 0.0), "salinity_psu": (salinity_psu, 0.0)}
    return rig_of(known | state)


def rig_of(known: dict[str, tuple[float, float]]) -> Rig:
    """A rig with this [optics]."""
    optics = OpticsSection.model_validate(known)
    return Rig(camera=CameraSection(driver="sim"), track=TrackSection(driver="sim"), optics=optics)


@pytest.fixture(scope="module")
def solved() -> Refractive:
    """Solved from exact marks in fresh water of 20 C, lens and port known."""
    optics = in_water(20.0, 0.0, **LENS).optics
    found = find_solver("refractive").solve(read_board(BOARD, VIEW.project), optics)
    assert isinstance(found, Refractive)
    return found


@examples(16)
@given(temperature_c=TEMPERATURES, salinity_psu=SALINITIES)
def test_exact_in_any_water(solved: Refractive, temperature_c: float, salinity_psu: float) -> None:
    """The same rig seen through other water: 1e-6 mm, what the solution from exact marks leaves."""
    view = View(n_water=refractive_index(temperature_c, salinity_psu, 650.0))
    found = map_for_rig(solved, in_water(temperature_c, salinity_psu)).to_plane(
        view.project(POINTS)
    )
    assert (found.status == Status.OK).all()
    np.testing.assert_allclose(found.xz_mm, POINTS, rtol=0, atol=1e-5)


def test_the_uncertainty_of_the_index_is_carried(solved: Refractive) -> None:
    """By propagation: what one standard deviation of the index displaces, beside the old errors.

    To 1 % of it: the map is linear in the index within 0.002 to 0.2 %.  Below 0 where the index
    moves nothing, by the modes of 1e-4 mm that do not count beside those of 0.3 mm.
    """
    tight, wide = (
        map_for_rig(solved, rig_of({"water_index": (1.338, sigma)})) for sigma in (0.0, 0.002)
    )
    above = map_for_rig(solved, rig_of({"water_index": (1.340, 0.0)}))
    pixels = replace(VIEW, n_water=1.338).project(POINTS)
    displaced = above.to_plane(pixels).xz_mm - tight.to_plane(pixels).xz_mm
    more = wide.to_plane(pixels).sigma_mm ** 2 - tight.to_plane(pixels).sigma_mm ** 2
    grown = np.sqrt(np.maximum(more, 0.0))
    np.testing.assert_allclose(grown, np.abs(displaced), rtol=0.01, atol=2e-4)


@dataclass(frozen=True)
class Changed(View):
    """A view with the camera moved along y, and turned about its own axes (rad)."""

    forward_mm: float = 0.0
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def axes(self) -> Floats:
        return super().axes() @ Rotation.from_rotvec(self.turn_rad).as_matrix()

    def eye_mm(self) -> Floats:
        x, z = self.target_mm
        straight = np.array([x, 0.0, z]) - self.distance_mm * super().axes()[:, 2]
        return straight + np.array([0.0, self.forward_mm, 0.0])


@pytest.mark.parametrize(
    ("stated", "changed"),
    [
        # A sheet that is moved away is a camera that is moved back.
        ({"sheet_shift_mm": 0.5}, [{"forward_mm": -0.5}]),
        ({"focal_percent": 0.1}, [{"focal_px": 850.85}]),
        ({"water_index": 0.001}, [{"n_water": VIEW.n_water + 0.001}]),
        (
            {"camera_tilt_deg": 0.05},
            [{"turn_rad": tuple(row)} for row in np.radians(0.05) * np.eye(3)],
        ),
    ],
)
def test_what_may_have_changed_enters_as_it_displaces(
    solved: Refractive, stated: dict[str, float], changed: list[dict[str, Any]]
) -> None:
    """Each change by one standard deviation, seen by a camera written from first principles.

    To 2 % and 1e-3 mm: 0.05 deg are 1 mm here, whose second order is 1 %.
    """
    since = SinceSection.model_validate(stated)
    pixels = VIEW.project(POINTS)
    before = solved.to_plane(pixels)
    rig = in_water(20.0, 0.0).model_copy(update={"since_calibration": since})
    after = map_for_rig(solved, rig).to_plane(pixels)
    np.testing.assert_array_equal(after.xz_mm, before.xz_mm)
    views = [Changed(**{**vars(VIEW), **change}) for change in changed]
    displaced = [solved.to_plane(view.project(POINTS)).xz_mm - POINTS for view in views]
    expected = np.sqrt((np.array(displaced) ** 2).sum(axis=0))
    # Below 0 by the rounding of tables (``pixel_table``) where a change does not move a point.
    more = np.sqrt(np.maximum(after.sigma_mm**2 - before.sigma_mm**2, 0.0))
    np.testing.assert_allclose(more, expected, rtol=0.02, atol=1e-3)


@pytest.fixture(scope="module")
def metric() -> Metric:
    """Solved from exact views by the paper's rig, its port and water known."""
    rig = paper_rig()
    views = views_of(rig, poses(rig, np.random.default_rng(3)))
    return calibrate_metric(views, known(rig), SIZE).plane_map


@examples(10)
@given(temperature_c=TEMPERATURES, salinity_psu=SALINITIES)
def test_a_metric_map_is_exact_in_any_water(
    metric: Metric, temperature_c: float, salinity_psu: float
) -> None:
    """Points of the sheet keep their x and z, whatever water they are seen through.

    To 1e-4 mm: what the solution from exact views leaves.
    """
    rig = paper_rig()
    assert rig.camera.port is not None
    index = refractive_index(temperature_c, salinity_psu, 650.0)
    other = replace(rig.camera, port=replace(rig.camera.port, water_index=index))
    pixels = np.stack(np.meshgrid([200.0, 320, 440], [150.0, 240, 330]), axis=-1).reshape(-1, 2)
    seen = project(other, rig.truth.meet(pixels))
    found = map_for_rig(metric, in_water(temperature_c, salinity_psu)).to_plane(seen)
    assert (found.status == Status.OK).all()
    np.testing.assert_allclose(found.xz_mm, rig.truth.locate(pixels), rtol=0, atol=1e-4)


def test_the_same_statement_moves_nothing(solved: Refractive) -> None:
    assert map_for_rig(solved, in_water(20.0, 0.0)) is solved
    silent = in_water(20.0, 0.0).model_copy(update={"optics": OpticsSection()})
    assert map_for_rig(solved, silent) is solved


TAP, SEA = 1.3313, 1.3390
KNOWN = {
    "focal_px": (850.0, 80.0),
    "gap_mm": (11.0, 3.0),
    "thickness_mm": (6.0, 0.3),
    **EXACT_BOARD,
}
SAID: dict[str, dict[str, Any]] = {
    "measured": {"water_index": (TAP, 2e-4)}, "vague": {"water_index": (1.333, 0.003)}, "none": {},
}  # fmt: skip
ENDS = np.array([[100.0, -200.0], [350.0, -200.0], [200.0, -100.0], [200.0, -350.0]])


def by_refractive(said: dict[str, Any]) -> tuple[PhysicalMap, Callable[[float], Floats], Floats]:
    """A map solved in tap water, where a water shows four places to its rig, and they, in mm."""
    reading = read_board(BOARD, replace(VIEW, n_water=TAP).project, 0.03, np.random.default_rng(5))
    optics = OpticsSection.model_validate(KNOWN | said)
    solved = find_solver("refractive").solve(reading, optics)
    assert isinstance(solved, PhysicalMap)
    return solved, lambda index: replace(VIEW, n_water=index).project(ENDS), ENDS


def by_metric(said: dict[str, Any]) -> tuple[PhysicalMap, Callable[[float], Floats], Floats]:
    """As ``by_refractive``."""
    rig, rng, ends = paper_rig(), np.random.default_rng(5), 0.8 * (ENDS - ENDS.mean(axis=0))
    views = [with_noise(view, 0.03, rng) for view in views_of(rig, poses(rig, rng, 9))]
    solved = calibrate_metric(views, OpticsSection.model_validate(KNOWN | said), SIZE).plane_map
    origin = rig.truth.meet(rig.truth.origin_px[None])

    def seen(index: float) -> Floats:
        port = replace(rig.camera.port, water_index=index)  # type: ignore[type-var]
        points = origin + ends @ rig.truth.axes[:, [0, 2]].T
        return project(replace(rig.camera, port=port), points)

    return solved, seen, ends


@pytest.mark.parametrize("said", SAID)
@pytest.mark.parametrize("solve", [by_refractive, by_metric])
def test_lengths_hold_in_other_water(solve: Any, said: str) -> None:
    """In the same water and in the sea, both stated: within 3 sigmas, which are no larger than due.

    A water known to 0.003 leaves 0.25 % of lengths open; one not stated, its difference besides.
    """
    solved, seen, ends = solve(SAID[said])
    true = np.hypot(*(ends[1::2] - ends[::2]).T)
    for index, most in ((TAP, 0.004), (SEA, 0.007)):
        points = map_for_rig(solved, rig_of({"water_index": (index, 2e-4)})).to_plane(seen(index))
        assert points.modes_mm is not None
        apart = points.xz_mm[1::2] - points.xz_mm[::2]
        length = np.hypot(*apart.T)
        modes = points.modes_mm[1::2] - points.modes_mm[::2]
        sigma = np.linalg.norm(np.einsum("nc,ncm->nm", apart / length[:, None], modes), axis=1)
        assert (np.abs(length - true) < 3 * sigma).all()
        assert (sigma / true).max() < (5e-4 if said == "measured" else most)


def test_an_older_file_is_carried_with_what_it_states_of_its_water() -> None:
    """It holds the modes that move the map as it is, and nothing of those that do elsewhere."""
    whole, seen, _ = by_refractive(SAID["vague"])
    modes, count = whole._modes_by_effect()
    kept = whole.parameters() | {"modes": modes[:, : count - 3].tolist()}
    older = find_solver("refractive").restore({k: v for k, v in kept.items() if k != "all_modes"})
    carried = (
        map_for_rig(plane_map, rig_of({"water_index": (SEA, 2e-4)})).to_plane(seen(SEA))
        for plane_map in (older, whole)
    )
    one, other = (np.ptp(points.modes_mm[:2, 0], axis=0) for points in carried)
    assert np.linalg.norm(one) == pytest.approx(np.linalg.norm(other), rel=0.2)


AIR, WINDOW = {"port": "none"}, {"gap_mm": (12.0, 2.0)}


@pytest.mark.parametrize(
    ("calibrated", "scanned", "refused"),
    [
        (AIR, WINDOW | SAID["measured"], True),
        (AIR, SAID["measured"], True),
        (SAID["measured"], AIR, True),
        (AIR, {}, False),
        (AIR, AIR, False),
        (WINDOW, SAID["measured"], False),
    ],
)
@pytest.mark.parametrize("name", ["refractive", "graticule-2"])
def test_what_two_files_state_of_the_port_is_compared(
    tmp_path: Path, name: str, calibrated: Any, scanned: Any, refused: bool
) -> None:
    """Also of a calibration from a file, and one whose map does not say what it was solved for."""
    reading = read_board(BOARD, View(water=False, k1=-0.15).project, 0.03, np.random.default_rng(1))
    solved = calibrate(reading, name, OpticsSection.model_validate(calibrated))
    save_calibration(tmp_path / "new.json", solved)
    silent = solved.plane_map.model_copy(update={"stated_port": None})  # type: ignore[attr-defined]
    save_calibration(tmp_path / "older.json", replace(solved, plane_map=silent))
    for file in ("new.json", "older.json"):
        plane_map, _ = load_plane_map(tmp_path / file)
        if not refused:
            map_for_rig(plane_map, rig_of(scanned))
            continue
        with pytest.raises(InputError, match=r"port.*states another port"):
            map_for_rig(plane_map, rig_of(scanned))


def test_a_map_in_other_water_knows_what_may_have_changed(solved: Refractive) -> None:
    """Whichever is said first, the water or the change."""
    since, water, pixels = SinceSection(sheet_shift_mm=0.5), (1.338, 0.001), VIEW.project(POINTS)
    one = solved.with_changes_since(since).in_water(water).to_plane(pixels)
    other = solved.in_water(water).with_changes_since(since).to_plane(pixels)
    np.testing.assert_array_equal(one.sigma_mm, other.sigma_mm)


@pytest.mark.parametrize("name", ["graticule-2", "spline"])
def test_maps_without_physics_are_refused(name: str) -> None:
    optics = in_water(20.0, 0.0).optics
    flat = find_solver(name).solve(read_board(BOARD, VIEW.project), optics)
    assert map_for_rig(flat, in_water(20.0, 0.0)) is flat
    # Half a degree off, and stated less surely: 4e-5 of the index, which nobody sees.
    assert map_for_rig(flat, rig_of({"temperature_c": (20.5, 0.5)})) is flat
    with pytest.raises(InputError, match=r"cannot be carried.*1\.338.*1\.331.*refractive"):
        map_for_rig(flat, in_water(10.0, 35.0))
    changed = in_water(20.0, 0.0).model_copy(
        update={"since_calibration": SinceSection(sheet_shift_mm=0.5)}
    )
    with pytest.raises(InputError, match="since_calibration"):
        map_for_rig(flat, changed)
    nothing = changed.model_copy(update={"since_calibration": SinceSection()})
    assert map_for_rig(flat, nothing) is flat


@pytest.mark.parametrize("name", ["graticule-2", "polynomial-3"])
def test_a_map_that_knows_no_water_says_what_another_would_do(name: str) -> None:
    """Calibrated without a word of the water: in the sea a length is open by the two indices."""
    solved = find_solver(name).solve(read_board(BOARD, VIEW.project))
    sea = in_water(10.0, 35.0)
    before, after = (
        there.to_plane(VIEW.project(ENDS)) for there in (solved, map_for_rig(solved, sea))
    )
    np.testing.assert_allclose(after.xz_mm, before.xz_mm, atol=1e-9)
    assert after.modes_mm is not None
    off = np.hypot(refractive_index(10.0, 35.0, 650.0) - 1.333, 0.003) / 1.333
    length = np.linalg.norm(after.modes_mm[1, 0, -3:] - after.modes_mm[0, 0, -3:])
    assert length == pytest.approx(250.0 * off, rel=0.01)
    assert "does not say in which water" in kept_for_want_of_water(solved, sea.optics)
    assert kept_for_want_of_water(solved, OpticsSection()) == ""


def test_a_map_whose_origin_sees_no_sheet_is_refused(metric: Metric) -> None:
    """As a file may hold it: the sheet's plane lies behind the camera."""
    fields = {name: getattr(metric, name) for name in Metric.model_fields}
    fields["q_per_mm"] = np.array([0.0, 0.0, -1e-3])
    with pytest.raises(InputError, match=r"in other water: origin_px"):
        Metric.model_validate(fields).in_water((1.339, 0.0))
