"""The design search of a study from end to end, its rendered tier the geometric one."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import sim.studies.running as running_module
from lscan.errors import InputError
from lscan.records import Floats
from sim.meshes import reflectance_at
from sim.studies.budget import StudyResults
from sim.studies.design.run import DESIGNS
from sim.studies.design.search import (
    AboveBounds,
    PredictedError,
    above_bounds,
    marks_sigma_px,
    predicted_pictures,
)
from sim.studies.results import load_results
from sim.studies.rig.evaluation import GeometricRig
from sim.studies.running import StudyOptions
from sim.studies.study import run_study
from sim.studies.studyfile import load_study
from sim.truth import board_truth

pytestmark = pytest.mark.xdist_group("design_run")  # one worker: they share a fixture

STUDY = """
name = "two webcams"
calibrate = "best/board"
scan = "best/sandwave"
places = { pictures = 2, columns = 40 }
precision = { base = 16, most = 16, alone = 16 }

[design]
sights = ["logitech-*"]
lasers = ["bq-*"]
windows = ["pmma-3mm"]
tracks = ["v-slot-tr8"]
trials = 2
population = 2
numbers = { stand_off_mm = [700, 950], "head.depression_deg" = [30] }

[cause.noise]
key = "sensor.noise"
when = "noise"
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("designs") / "study.toml"
    file.write_text(STUDY, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def problem_error(file: Path) -> PredictedError:
    study = load_study(file)
    return PredictedError(
        study.document, study.calibrate.document, study.scan.document, study.source
    )


@pytest.fixture(scope="module")
def found(file: Path) -> Iterator[tuple[Path, StudyResults, list[str]]]:
    """What a study found, and said, whose pictures show what is predicted of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running_module, "prepare", predicted_pictures)
        patch.setattr(running_module, "RenderedRig", GeometricRig)
        folder = file.parent / "out"
        said: list[str] = []
        yield folder, run_study(file, folder, StudyOptions("none"), say=said.append), said


@pytest.mark.slow
def test_a_winner_rendered_as_predicted_has_the_predicted_error(
    found: tuple[Path, StudyResults, list[str]],
) -> None:
    folder, results, said = found
    (estimate,) = (line for line in said if line.startswith("designs: 2, each of 16 rigs"))
    assert "min" in estimate and "own rig is predicted" in estimate
    assert len(results.trials) == 2
    rendered = [trial for trial in results.trials if trial.rendered_mm]
    assert rendered and all(trial.on_front and trial.status == "ok" for trial in rendered)
    for trial in rendered:
        assert trial.rendered_mm and trial.predicted_mm
        assert trial.rendered_mm.value == pytest.approx(trial.predicted_mm, rel=1e-12)
    assert load_results(folder) == results
    assert "two webcams" in (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_search_goes_on_from_half_of_its_trials_to_the_same_bytes(
    file: Path, found: tuple[Path, StudyResults, list[str]]
) -> None:
    folder, results, _ = found
    whole = (folder / DESIGNS).read_bytes()
    content = json.loads(whole)
    content["trials"] = content["trials"][:1]
    (folder / DESIGNS).write_text(json.dumps(content), encoding="utf-8")
    again = run_study(file, folder, StudyOptions("none", resume=True))
    assert again.trials == results.trials
    assert (folder / DESIGNS).read_bytes() == whole


def test_more_runs_than_agreed_to_are_refused_before_any(file: Path, tmp_path: Path) -> None:
    """32 of two designs and 12 rendered, and those of the budget."""
    with pytest.raises(InputError, match="too many runs"):
        run_study(file, tmp_path / "out", StudyOptions("none", at_most=44))
    assert not (tmp_path / "out").exists()


def test_the_board_is_exposed_as_well_as_the_study_s(problem_error: PredictedError) -> None:
    """Half the f-number gathers four times the light; a pixel of twice the side as well."""
    scan, own = problem_error.scan, 20.0
    cases: tuple[tuple[str, Mapping[str, float]], ...] = (
        ("lens", {"f_number": 1.4}),
        ("sensor", {"pixel_um": 12.0}),
    )
    for section, keys in cases:
        study = problem_error.of_design({**scan, section: {**scan[section], **keys}})
        assert study.calibrate.rig.camera.exposure_ms == pytest.approx(own / 4)
        assert study.scan.rig.camera.exposure_ms == own


def test_the_marks_scatter_as_a_disc_s_centre_in_white_noise(problem_error: PredictedError) -> None:
    """Its bound falls as the root of the radius: dots of 5 mm beside marks of 2 mm."""
    study = problem_error.of_design(problem_error.scan)
    bound = marks_sigma_px(study.calibrate)
    assert bound.shape == (len(bound),) and (bound > 0).all()
    assert bound[-1] / bound[0] == pytest.approx(np.sqrt(2.5))


def test_the_marks_scatter_as_fisher_s_information_of_a_drawn_disc_says(
    problem_error: PredictedError,
) -> None:
    """A disc as wide as the board's dots, blurred, averaged over pixels, and moved.

    To 5 %: the bound takes its rim for a straight edge, which costs some 3/8 (blur / radius)², at
    these 2.8 px 3 %, and drawing it in tenths of a pixel 0.5 %.
    """
    scene = problem_error.of_design(problem_error.scan).calibrate
    noisy = scene.with_tank(sensor={"dark_noise_e": 5e3, "dsnu_e": 0.0, "prnu": 0.0})
    grid, sensor, target = noisy.board().grid, noisy.tank.sensor, noisy.tank.target
    dots = board_truth(noisy).centres.grid.image_px.reshape(grid.rows, grid.columns, 2)
    apart_px = np.nanmedian(np.linalg.norm(np.diff(dots, axis=1), axis=-1))
    radius_px, fine = apart_px * grid.dot_diameter_mm / grid.pitch_mm / 2, 10
    half = int(radius_px + 6) * fine
    y, x = np.mgrid[-half:half, -half:half] + 0.5

    def drawn(moved_px: float) -> Floats:
        disc = (np.hypot(x - fine * moved_px, y) <= fine * radius_px).astype(float)
        blurred = gaussian_filter(disc, fine * noisy.tank.lens.blur_px)
        return blurred.reshape(2 * half // fine, fine, -1, fine).mean(axis=(1, 3))

    slope = (drawn(0.1) - drawn(-0.1)) / 0.2  # takes (0.1 / blur)² / 4 off
    contrast_dn = 200 * (1 - target.mark_albedo / reflectance_at(target.albedo, 550.0))
    noise_dn = np.hypot(255 * sensor.gain / sensor.full_well_e * 5e3, np.sqrt(1 / 12))
    expected = noise_dn / contrast_dn / np.linalg.norm(slope)
    assert marks_sigma_px(noisy)[0] == pytest.approx(expected, rel=0.05)


def test_what_is_predicted_above_bounds_is_found_so(problem_error: PredictedError) -> None:
    """The two are each other's inverse: no scatter is drawn, so to rounding."""
    study = problem_error.of_design(problem_error.scan)
    stated = AboveBounds(sensor=2.5, both=1.25, marks=1.5)
    found = above_bounds(study, predicted_pictures(study, stated))
    for name, value in vars(stated).items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-9), name
