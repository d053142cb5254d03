"""A suite has the same bytes whoever made it and however often that was ended; truth fits light."""

import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import combinations

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import ROOT
from truth_scenes import tank

from lscan.board import read_board
from lscan.config.scenes import spec_names
from lscan.errors import InputError
from lscan.files.disk import lock_folder
from lscan.records import Status
from lscan.suites import open_suite, verify_suite
from lscan.suites.content import LEAST_DN, STEPS, layers_of_picture, layers_picture
from sim.datasets import suite, suite as suitespec
from sim.datasets.cases import line_case, line_truths
from sim.datasets.labels import one_step_w_m2_sr
from sim.datasets.suite import covering, load_suite_spec, make_cached_suite, make_suite
from sim.render.layers import Layers

SMALL = """
name = "small"

[lines]
scene = "paper/groove"
pictures = 8
turned = 4
pairs = 8

[lines.base.camera]
width_px = 64
height_px = 100
options = { auto_exposure = true, max_ms = 10000.0, percentile = 98.0 }

[lines.base.lens]
centre_px = [159.5, -112.5]

[lines.base.render]
scatter_samples = 0

[lines.render.laser.line]
[lines.render.laser.none.laser]
on = false
[lines.render.laser.two.stripe]
returns = "last"
[lines.render.laser.two.laser]
lines = [{ tilt_deg = -1.0, share = 0.5 }, { tilt_deg = 1.0, share = 0.5 }]

[lines.expose.noise.usual]
[lines.expose.noise.low.sensor]
dark_noise_e = 10.0
[lines.expose.fault.none]
[lines.expose.fault.gamma.sensor]
gamma = 2.2

[boards]
scene = "paper/board"
pictures = 2

[boards.base.camera.options]
auto_exposure = true
max_ms = 10000.0

[boards.render.place.off.target]
tilt_x_deg = 1.0

[boards.expose.noise.usual]
[boards.expose.noise.high.sensor]
dark_noise_e = 150.0
"""


ONE_RENDER = """
name = "small"

[lines]
scene = "paper/groove"
pictures = 2

[lines.base.camera]
width_px = 64
height_px = 100

[lines.base.lens]
centre_px = [159.5, -112.5]

[lines.base.render]
scatter_samples = 0

[lines.render.laser.line]

[lines.expose.noise.usual]
[lines.expose.noise.low.sensor]
dark_noise_e = 10.0
"""

pytestmark = pytest.mark.xdist_group("small_suite")  # one worker: they share a fixture


@pytest.fixture(scope="module")
def spec_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("spec") / "small.toml"
    file.write_text(SMALL)
    return file


@pytest.fixture(scope="module")
def made(spec_file):
    """The suite, made in this process."""
    return make_suite(load_suite_spec(spec_file), spec_file.parent / "small.zip", workers="none")


def test_the_truth_lies_on_the_light(made):
    """Where a column has one line, the brightest pixel is within 3 sigma and a pixel of the truth.

    Beyond 3 sigma lies 0.3 % of a line's light; a pixel for where the centre is within its own.
    """
    suite = verify_suite(made)
    assert len(suite.content.cases) == 8
    kinds = set()
    for case in suite.cases():
        kinds.add((case.axes["laser"], case.axes["lines"]))
        picture = case.picture if case.settings.axis == "columns" else case.picture.swapaxes(0, 1)
        truth = case.truth
        shown = (truth.status == Status.OK) & (truth.multiple == 0)
        if case.axes["laser"] == "none":
            assert not shown.any()
        if case.axes["laser"] == "line":
            assert shown.mean() > 0.5
            brightest = picture[..., 0].astype(float).argmax(axis=0)
            inside = np.abs(brightest - truth.centre_px) <= 3 * truth.sigma_px + 1
            assert inside[shown & (truth.height_dn > 10 * truth.noise_dn)].all()
        if case.dark is not None:
            assert case.dark.mean() < case.picture.mean() or case.axes["laser"] == "none"
    assert {lines for _, lines in kinds} == {"columns", "rows"}
    assert {laser for laser, _ in kinds} == {"line", "none", "two"}


@pytest.mark.parametrize("metered", [False, True])
def test_the_layers_are_the_light_of_the_picture(metered):
    """Of a webcam without noise, blur and vignetting whose numbers are linear in the light.

    To the rounding of picture and layers: the number has been rounded once, and so has each layer.
    """
    scene = tank(
        floor={"z_mm": -100.0},
        camera={
            "width_px": 64, "height_px": 48, "exposure_ms": 3.0,
            "options": {"auto_exposure": metered, "max_ms": 1e4, "percentile": 98.0},
        },
        lens={"vignetting": 0.0, "blur_px": 0.0},
        sensor={"noise": False, "gamma": 1.0},
    )  # fmt: skip
    rng = np.random.default_rng(3)
    radiance = 40 * one_step_w_m2_sr(scene)
    direct, scattered = rng.uniform(0, radiance, (2, 48, 64)).astype(np.float32)
    case = line_case(scene, "one", {}, Layers(direct, scattered, 0 * direct), line_truths(scene))
    kept = layers_of_picture(layers_picture(case.layers))
    black, half = scene.tank.sensor.black_level_dn, 2 ** (0.5 / STEPS) - 1
    for layers, rounding in ((case.layers, 0.0), (kept, half)):
        light = layers.direct + layers.scattered
        shown = case.picture[..., 0].astype(float)
        error = np.abs(shown - np.minimum(light + black, 255))
        assert np.all(error <= 0.5 + 1e-3 * light + rounding * (light + 2 * LEAST_DN))
    assert (np.percentile(case.layers.direct, 98) > 60) == metered


def test_two_lines_have_the_truth_of_the_one_that_is_meant(made):
    """Of returns = "last" the lower one: light of the other lies above it."""
    suite = open_suite(made)
    two = [case for case in suite.cases() if case.axes["laser"] == "two"]
    assert two
    for case in two:
        shown = np.flatnonzero((case.truth.status == Status.OK) & (case.truth.multiple == 0))
        picture = case.picture if case.settings.axis == "columns" else case.picture.swapaxes(0, 1)
        above = [picture[: int(case.truth.centre_px[u] - 6), u, 0].max() for u in shown]
        assert np.median(above) > 3 * np.median(picture[:5, :, 0])


@pytest.mark.slow
def test_the_bytes_are_the_same_on_two_workers_and_after_a_kill(made, spec_file, tmp_path):
    spec = load_suite_spec(spec_file)
    killed = tmp_path / "killed.zip"
    line = (
        f"from sim.cli.app import main; import sys; sys.argv = {_make(spec_file, killed)}; main()"
    )
    child = subprocess.Popen([sys.executable, "-c", line], cwd=ROOT, start_new_session=True)
    partial = tmp_path / "killed.zip.partial"
    while child.poll() is None and not list(partial.glob("*/truth.csv")):
        time.sleep(0.01)
    os.killpg(child.pid, signal.SIGKILL)
    child.wait()
    shown = []
    make_suite(spec, killed, workers=2, progress=lambda done, total: shown.append((done, total)))
    assert killed.read_bytes() == made.read_bytes()
    assert not partial.exists()
    assert shown[-1] == (10, 10)


def _make(spec_file, archive):
    return ["lscan-sim", "suite", "make", str(spec_file), "-o", str(archive), "--workers", "1"]


def test_a_suite_of_before_makes_room_in_the_cache(tmp_path, monkeypatch):
    """Of another version, or of another seed; this very suite is left, if not asked for afresh."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    spec_file = tmp_path / "small.toml"
    spec_file.write_text(ONE_RENDER)
    spec, file = load_suite_spec(spec_file), tmp_path / "lscan" / "suites" / "small.zip"
    made = make_suite(spec, tmp_path / "made.zip", workers="none")
    file.parent.mkdir(parents=True)
    file.write_bytes(b"of before")
    assert make_cached_suite(spec, "small", workers="none") == file
    assert file.read_bytes() == made.read_bytes()
    assert [entry.name for entry in file.parent.iterdir()] == ["small.zip"]
    os.utime(file, (0, 0))
    make_cached_suite(spec, "small", workers="none")
    assert file.stat().st_mtime == 0
    make_cached_suite(spec, "small", workers="none", afresh=True)
    assert file.stat().st_mtime > 0
    assert file.read_bytes() == made.read_bytes()
    make_cached_suite(load_suite_spec(spec_file, 99), "small", workers="none")
    assert open_suite(file).content.seed == 99


def test_another_seed_gives_other_pictures_and_is_not_mixed(made, spec_file):
    with pytest.raises(InputError, match="holds another suite"):
        make_suite(load_suite_spec(spec_file, seed=2), made, workers="none")
    folder = made.with_name("other.zip.partial")
    (folder / "case-000").mkdir(parents=True)
    (folder / "case-000" / "truth.csv").touch()
    (folder / "identity.json").write_text('{"made_by": "lscan of yore"}')
    with pytest.raises(InputError, match="cases of another suite"):
        make_suite(load_suite_spec(spec_file), made.with_name("other.zip"), workers="none")


def test_a_spec_that_is_refused_leaves_nothing_in_the_way(spec_file, tmp_path, monkeypatch):
    """Refused before its first render, or by it: the corrected spec is made in its place."""
    spec, file = load_suite_spec(spec_file, seed=5), tmp_path / "made.zip"

    def refused(*_):
        raise InputError("a scene is wrong")

    with monkeypatch.context() as patch:
        patch.setattr(suitespec.CaseSet, "scene", refused)
        with pytest.raises(InputError, match="a scene is wrong"):
            make_suite(spec, file, workers="none")
    assert not [*tmp_path.glob("*.partial")]
    with monkeypatch.context() as patch:
        patch.setattr(suite, "make_cases", refused)
        with pytest.raises(InputError, match="a scene is wrong"):
            make_suite(spec, file, workers="none")
        with pytest.raises(InputError, match="a scene is wrong"):  # not of what lies there
            make_suite(load_suite_spec(spec_file, seed=6), file, workers="none")


def test_a_spec_is_the_same_wherever_it_lies_and_another_where_its_files_are(tmp_path):
    """A texture beside the spec, in two folders; then one of them is painted over."""
    textured = """
[lines.render.target.textured.target]
texture = { file = "checks.png", corner_mm = [0.0, -60.0], size_mm = [20.0, 20.0] }
"""
    sums = []
    for name in ("here", "there"):
        folder = tmp_path / name
        folder.mkdir()
        shutil.copy(ROOT / "scenes" / "targets" / "checks.png", folder)
        before, usual, after = SMALL.partition("[lines.expose.noise.usual]\n")
        (folder / "small.toml").write_text(before + textured + usual + after)
        sums.append(load_suite_spec(folder / "small.toml").sha256)
    assert sums[0] == sums[1]
    (tmp_path / "there" / "checks.png").write_bytes(b"another")
    assert load_suite_spec(tmp_path / "there" / "small.toml").sha256 != sums[0]


def test_tables_of_fewer_photons_make_another_suite(made, spec_file, monkeypatch):
    """The light of higher orders is that of tables, whose noise is of the photons counted."""
    monkeypatch.setenv("LSCAN_PHOTONS", "16384")
    with pytest.raises(InputError, match="holds another suite"):
        make_suite(load_suite_spec(spec_file), made, workers="none")


def test_two_processes_do_not_make_one_suite(spec_file):
    file = spec_file.parent / "locked.zip"
    folder = file.with_name("locked.zip.partial")
    folder.mkdir()
    lock = lock_folder(folder)
    try:
        with pytest.raises(InputError, match="is being written by another"):
            make_suite(load_suite_spec(spec_file), file, workers="none")
    finally:
        os.close(lock)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n == "full" else n for n in spec_names("suite")],
)
def test_the_suites_of_lscan_cover_every_pair_of_values(name):
    for among in load_suite_spec(name).case_sets:
        cases = among.cases()
        values = {**among.file.render, **among.file.expose}
        rows = [among.axes_of(case) for case in cases]
        for one, other in combinations(values, 2):
            seen = {(row[one], row[other]) for row in rows}
            assert seen == {(a, b) for a in values[one] for b in values[other]}
        for case in cases[:: max(1, len(cases) // 4)]:
            among.scene(case)


def test_the_boards_truth_is_what_is_read(made):
    """Marks by our own reader, in its stated sigmas: chi squared of 200 coordinates a picture is
    within 5 of its standard deviations of 200; the map: the marks' own places on a board that is
    not tilted differ from the sheet's by nothing, on this one by what a degree moves them.
    """
    suite = open_suite(made)
    assert {case.axes["noise"] for case in suite.boards()} == {"usual", "high"}
    for case in suite.boards():
        reading = read_board(case.picture, case.board)
        count = len(reading.grid.status)
        off = reading.grid.image_px - case.marks.image_px[:count]
        assert reading.grid.found.all()
        # The reader states the noise's part; the pictures of few samples have grain besides.
        assert np.sqrt((off**2).mean()) < 3 * np.sqrt((reading.grid.sigma_px**2).mean())
        assert (case.marks.status == Status.OK).all()
        assert len(case.map_px) == len(case.map_mm) == 25**2
        corner = np.abs(case.map_mm - [0.0, 0.0]).sum(axis=1).argmin()
        away = np.linalg.norm(case.map_px[corner] - case.marks.image_px[0])
        assert away < 1e-3  # the board is turned about that very corner


def test_boards_need_a_board(spec_file, tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(SMALL.replace('scene = "paper/board"', 'scene = "paper/groove"'))
    with pytest.raises(InputError, match=r"boards\.scene.*paper/groove"):
        make_suite(load_suite_spec(file), tmp_path / "wrong.zip", workers="none")


@examples(30)
@given(sizes=st.lists(st.integers(1, 4), min_size=1, max_size=4), seed=st.integers(0, 99))
def test_a_covering_has_every_pair_and_less_than_the_product(sizes, seed):
    axes = [tuple(map(str, range(size))) for size in sizes]
    rows = list(covering(axes, [], np.random.default_rng(seed)))
    for i, j in combinations(range(len(axes)), 2):
        assert {(row[i], row[j]) for row in rows} == {(a, b) for a in axes[i] for b in axes[j]}
    assert len(rows) <= np.prod(sizes)
    assert rows == list(covering(axes, [], np.random.default_rng(seed)))


def test_what_needs_another_render_is_no_exposure(spec_file, tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(SMALL + "[lines.expose.width.wide.laser]\nwaist_mm = 3.0\n")
    with pytest.raises(
        InputError, match=r"expose: width\.wide\.laser\.waist_mm needs another render"
    ):
        load_suite_spec(file)
