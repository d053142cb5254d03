"""What is said of a rig before a scan, against pictures of it and against the truth."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from lscan.errors import InputError
from lscan.records import has_value
from lscan.stripe import extract_stripe
from sim.cli.app import app
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from sim.sensor import Webcam
from sim.studies.rigcheck import RigCheck, check_lines, check_rig
from sim.truth import stripe_truth
from tests.validation.exposures import expose, webcam_of

GROOVE = load_scene("best/groove")


def with_rig(scene: Scene, **sections: dict[str, Any]) -> Scene:
    """The scene with keys of the rig's sections replaced."""
    update = {
        name: getattr(scene.rig, name).model_copy(update=keys) for name, keys in sections.items()
    }
    return replace(scene, rig=scene.rig.model_copy(update=update))


@pytest.fixture(scope="module")
def found() -> RigCheck:
    return check_rig(GROOVE)


def middle_mm(scene: Scene) -> float:
    positions = scene.rig.plan.positions_mm()
    return positions[len(positions) // 2]


@pytest.mark.parametrize(
    ("gamma", "exposure_ms"),
    [(2.2, 26.0), *(pytest.param(1.0, ms, marks=pytest.mark.slow) for ms in (20.0, 60.0))],
)
def test_brightness_is_that_of_a_picture_without_noise(gamma: float, exposure_ms: float) -> None:
    scene = with_rig(GROOVE, camera={"exposure_ms": exposure_ms})
    scene = scene.with_tank(sensor={"gamma": gamma})
    found = check_rig(scene)
    quiet = scene.with_tank(sensor={"noise": False, "speckle": "none"})
    layers = Tank(scene).render(middle_mm(scene))
    picture = Webcam(quiet).expose(layers, exposure_ms, np.random.default_rng(0))[..., 0]
    brightest = picture.max(axis=0)[found.entry].astype(float)
    # What the picture rounds, and columns whose brightest pixel is a reflection of the line.
    apart = np.abs(found.grey_dn[0] - brightest)
    assert np.quantile(apart, 0.9) <= 0.51
    assert np.mean(found.clipped) == pytest.approx(np.mean(brightest == 255), abs=0.01)


@pytest.mark.slow
def test_uncertainty_is_the_scatter_of_pictures() -> None:
    """In clear water, for light that is scattered beside the line is in no bound: within 15 %."""
    scene = GROOVE.with_tank(water={"turbidity_ntu": 0.05})
    found = check_rig(scene)
    layers = Tank(scene).render(middle_mm(scene))
    centres = []
    for seed in range(24):
        stripe = extract_stripe(
            expose(webcam_of(scene, seed), layers, scene, (seed, 0)), scene.rig.stripe
        )
        valued = np.where(has_value(stripe.status), stripe.centre_px, np.nan)
        centres.append(valued[found.entry])
    scatter_mm = np.std(centres, axis=0, ddof=1) * found.mm_per_px[:, 1]
    known = np.isfinite(scatter_mm)
    assert known.mean() > 0.9
    # Of 23 degrees of freedom the variance's mean over columns is good to 2 %.
    seen = np.sqrt(np.median(scatter_mm[known] ** 2))
    assert np.median(found.sigma_z_mm[1][known]) == pytest.approx(seen, rel=0.15)
    assert (found.sigma_z_mm[0] < found.sigma_z_mm[1]).all()


def test_scales_are_those_of_a_target_that_is_moved(found: RigCheck) -> None:
    lifted_mm = 0.5
    truth = stripe_truth(GROOVE, middle_mm(GROOVE))
    x, y, z = GROOVE.tank.target.position_mm
    lifted = GROOVE.with_tank(target={"position_mm": (x, y, z + lifted_mm)})
    moved = stripe_truth(lifted, middle_mm(GROOVE))
    both = found.entry[(truth.face == moved.face)[found.entry]]
    here = np.isin(found.entry, both)
    # A level face, lifted: at the same column its height has changed by as much.
    level = np.abs(moved.xz_mm[both, 1] - truth.xz_mm[both, 1] - lifted_mm) < 1e-3
    assert level.sum() > 100
    per_px = lifted_mm / np.abs(moved.centre_px - truth.centre_px)[both][level]
    np.testing.assert_allclose(found.mm_per_px[here, 1][level], per_px, rtol=0.01)
    beside = both[1:][(np.diff(both) == 1) & level[1:] & level[:-1]]
    apart = np.linalg.norm(truth.xz_mm[beside] - truth.xz_mm[beside - 1], axis=1)
    along = found.mm_per_px[np.isin(found.entry, beside), 0]
    assert np.median(along / apart) == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (with_rig(GROOVE, stripe={"channel": "blue"}), r"channel = .blue.*650 nm best in red"),
        (GROOVE.with_tank(sensor={"gamma": 2.2}), r"gamma = 2.2, which stripe.gamma"),
        (GROOVE.with_tank(sensor={"dark_noise_e": 200.0}), r"noise.read_dn = 0.95, the tank's is"),
        (GROOVE.with_tank(lens={"f_number": 11.0}), r"stripe.noise.speckle"),
        (GROOVE.with_tank(head={"speed_mm_s": 500.0}), r"moves by 10 mm while"),
    ],
)
def test_what_contradicts_something_is_named(found: RigCheck, scene: Scene, words: str) -> None:
    doubts = replace(found, scene=scene).doubts
    assert len(doubts) == len(found.doubts) + 1
    assert any(re.search(words, doubt) for doubt in doubts)


def test_light_that_does_not_serve_is_named(found: RigCheck) -> None:
    for times, words in ((20.0, "99% of the line is clipped: "), (0.05, "100% .* is below .*or ")):
        light = replace(found.light, crest_dn=times * found.light.crest_dn)
        lines = check_lines(replace(found, light=light))
        assert re.match(f"doubt: {words}camera.exposure_ms = ", lines[-1]), lines


@pytest.mark.slow
def test_the_advised_exposure_puts_the_line_where_it_says(found: RigCheck) -> None:
    advised = check_rig(with_rig(GROOVE, camera={"exposure_ms": found.exposure_ms}))
    assert np.quantile(advised.grey_dn[0], 0.95) == pytest.approx(200, abs=0.1)
    assert advised.exposure_ms == pytest.approx(found.exposure_ms, rel=1e-3)


def test_a_board_is_counted_and_a_rig_that_sees_nothing_is_refused() -> None:
    board = check_rig(load_scene("paper/board"))
    assert board.marks is not None and board.marks[0] == board.marks[1] > 100
    assert board.doubts == [] and "laser: off" in check_lines(board)
    aside = load_scene("paper/board").with_tank(head={"heading_deg": 12.0})
    assert "of the board's" in "".join(check_rig(aside).doubts)
    away = GROOVE.with_tank(head={"heading_deg": 80.0})
    with pytest.raises(InputError, match="lit and seen nowhere"):
        check_rig(away)


def test_the_command_prints_and_draws(tmp_path: Path) -> None:
    file = tmp_path / "check.png"
    done = CliRunner().invoke(app, ["check", "best/groove", "--picture", str(file)])
    assert done.exit_code == 0 and done.output.startswith("view: ")
    assert "laser: class 2" in done.output
    assert cv2.imread(str(file)).shape[0] > 500
    told = json.loads(CliRunner().invoke(app, ["check", "best/groove", "--json"]).output)
    assert told["marks_seen"] is None and told["columns"] > 500
    low, middle, high = told["sigma_z_mm"]
    assert 0 < low < middle < high < 1
    assert told["clipped"] == 0
