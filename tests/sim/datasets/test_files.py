"""The files of ``lscan-sim render`` and ``truth``: what they hold, and bad input."""

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from places import SCENES
from truth_scenes import BASE, BOARD, tank
from typer.testing import CliRunner

from lscan.acquisition.run import open_run
from lscan.acquisition.scan import scan
from lscan.acquisition.writer import create_run
from lscan.config.documents import merge, named_files, write_toml
from lscan.config.rig import RigFile, load_rig, parse_rig
from lscan.errors import InputError
from lscan.records import Status
from sim.cli.app import app
from sim.datasets.files import TruthTable, taken_at, taken_in, write_render, write_truth
from sim.datasets.labels import Label, check_sampling, colour_labels, label_scene, line_sigma_px
from sim.devices import TankCamera
from sim.render.layers import Layers
from sim.scene import Scene, load_scene, scene_of
from sim.truth import board_truth, line_brightness, stripe_truth

CAMERA = {"width_px": 64, "height_px": 48}
LENS = {"focal_px": 85.0, "centre_px": [31.5, 23.5]}
FLOOR_MM, APEX_MM = -100.0, 500.0
TILTS_DEG = (-4.0, 0.0, 4.0)
LINES = [{"tilt_deg": tilt, "share": 0.3} for tilt in TILTS_DEG]


def small(**sections: Any) -> Scene:
    """A level floor seen by a small camera."""
    base: dict[str, Any] = {"camera": CAMERA, "lens": LENS, "floor": {"z_mm": FLOOR_MM}}
    return tank(**(base | sections))


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def test_a_line_has_one_table_that_reads_back_as_the_truth(tmp_path: Path) -> None:
    scene = small(laser={"tilt_deg": 3.0})
    files = write_truth(scene, taken_at(scene, [12.5]), tmp_path)
    assert files == {"stripe": TruthTable(tmp_path / "stripe.csv", {"OK": 64})}
    rows, truth = read(files["stripe"].file), stripe_truth(scene, 12.5)
    # Floats are written with all their digits: they read back as they were.
    np.testing.assert_array_equal(column(rows, "column"), np.arange(64))
    np.testing.assert_array_equal(column(rows, "centre_px"), truth.centre_px)
    np.testing.assert_array_equal(column(rows, "x_mm"), truth.xz_mm[:, 0])
    np.testing.assert_array_equal(column(rows, "y_mm"), truth.y_mm)
    np.testing.assert_array_equal(column(rows, "z_mm"), truth.xz_mm[:, 1])
    assert [int(row["lit"]) for row in rows] == truth.lit.tolist()
    assert [int(row["seen"]) for row in rows] == truth.seen.tolist()
    assert [int(row["multiple"]) for row in rows] == truth.multiple.tolist()
    np.testing.assert_array_equal(column(rows, "edge_px"), truth.edge_px)
    (light,) = line_brightness(scene, [truth])
    for name in ("height_dn", "height_sigma_dn", "noise_dn", "snr"):
        np.testing.assert_array_equal(column(rows, name), getattr(light, name))
    assert [row["status"] for row in rows] == [Status(code).name for code in truth.status]
    assert any(row["status"] == "OK" for row in rows)


def test_each_of_several_lines_has_a_table(tmp_path: Path) -> None:
    """A sheet that leans by t meets a floor h below its apex at y = h tan t (its own lean)."""
    scene = small(laser={"lines": LINES})
    files = write_truth(scene, taken_at(scene, [0.0]), tmp_path)
    assert list(files) == ["stripe-0", "stripe-1", "stripe-2"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{name}.csv" for name in files]
    for table, tilt in zip(files.values(), TILTS_DEG, strict=True):
        rows = [row for row in read(table.file) if row["status"] == "OK"]
        assert len(rows) > 30
        lean = (APEX_MM - FLOOR_MM) * np.tan(np.radians(tilt))
        # Double precision over lengths of a metre; nothing else stands between.
        np.testing.assert_allclose(column(rows, "y_mm"), lean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(column(rows, "z_mm"), FLOOR_MM, rtol=0, atol=1e-9)


def test_a_board_has_a_table_beside_the_line(tmp_path: Path) -> None:
    scene = small(board=BOARD, target={"shape": "board"})
    files = write_truth(scene, taken_at(scene, [0.0]), tmp_path)
    assert list(files) == ["stripe", "board"]
    rows, grid = read(files["board"].file), board_truth(scene, 0.0).centres.grid
    np.testing.assert_array_equal(column(rows, "u_px"), grid.image_px[:, 0])
    dark = small(board=BOARD, target={"shape": "board"}, laser={"on": False})
    assert list(write_truth(dark, taken_at(dark, [0.0]), tmp_path / "dark")) == ["board"]


def test_bad_input_leaves_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "none"
    with pytest.raises(InputError, match="no truth to write: the laser is off"):
        write_truth(small(laser={"on": False}), taken_at(small(), [0.0]), folder)
    for place in (float("nan"), 2e5):
        with pytest.raises(InputError, match="--position"):
            taken_at(small(), [0.0, place])
        with pytest.raises(InputError, match="--position"):
            write_render(small(), place, folder)
    with pytest.raises(InputError, match="--samples: not a square number"):
        write_render(small(), 0.0, folder, samples=5)
    assert not folder.exists()


@pytest.mark.slow
def test_a_render_has_picture_layers_and_labels(tmp_path: Path) -> None:
    """In pure water the line's light prevails: the pixel of each true centre is the line.

    The line's sigma, 4 mm or a third of a pixel, is as wide as the pixel's samples are apart,
    so none of it falls between them.
    """
    scene = small(laser={"lines": LINES, "waist_mm": 8.0}, water={"kind": "pure"})
    files = write_render(scene, 0.0, tmp_path / "new")
    names = ["picture.png", "layers.npz", "labels.png", "labels-colour.png"]
    assert [path.name for path in files.values()] == names
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(names)
    with np.load(files["layers"], allow_pickle=False) as stored:
        layers = Layers(**stored)
    assert layers.direct.dtype == np.float32 and layers.direct.shape == (48, 64)
    picture = cv2.imread(str(files["picture"]), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (48, 64, 3)
    labels = cv2.imread(str(files["labels"]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(labels, label_scene(scene, 0.0, layers))
    coloured = cv2.imread(str(files["labels in colour"]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(coloured[..., ::-1], colour_labels(labels))
    for line in range(len(LINES)):
        truth = stripe_truth(scene, 0.0, line)
        shown = np.flatnonzero(truth.status == Status.OK)
        rows = np.rint(truth.centre_px[shown]).astype(int)
        assert len(shown) > 30
        assert np.all(labels[rows, shown] == Label.LINE)


def test_without_the_laser_all_light_is_ambient(tmp_path: Path) -> None:
    scene = small(laser={"on": False}, light={"ambient_w_m2_sr": 0.5})
    files = write_render(scene, 0.0, tmp_path)
    labels = cv2.imread(str(files["labels"]), cv2.IMREAD_UNCHANGED)
    assert np.all(labels == Label.AMBIENT)


def test_several_positions_are_frames_of_one_table(tmp_path: Path) -> None:
    scene = str(SCENES / "targets" / "sandwave.toml")
    places = ["--position", "90.5", "--position", "-20"]
    done = CliRunner().invoke(app, ["truth", scene, "-o", str(tmp_path), *places])
    assert done.exit_code == 0, done.output
    rows, loaded = read(tmp_path / "stripe.csv"), load_scene(Path(scene))
    assert len(rows) == 2 * 640
    shown = sum(row["status"] == "OK" for row in rows)
    assert f"stripe: 2 pictures, 1280 entries: {shown} OK" in done.output
    for frame, place in enumerate([90.5, -20.0]):
        part = [row for row in rows if row["frame"] == str(frame)]
        assert {row["position_mm"] for row in part} == {repr(place)}
        truth = stripe_truth(loaded, place)
        np.testing.assert_array_equal(column(part, "centre_px"), truth.centre_px)


def recorded(folder: Path, options: str = "") -> Path:
    """A scan of three small pictures of the block, its run folder."""
    (folder / "scene.toml").write_text(
        f'include = "{SCENES / "paper" / "groove.toml"}"\n'
        "[camera]\nwidth_px = 64\nheight_px = 48\nexposure_ms = 15.0\n"
        f"options = {{{options}}}\n"
        "[lens]\nfocal_px = 85.0\ncentre_px = [31.5, 23.5]\n"
        "[plan]\nstart_mm = -5.0\nstep_mm = 2.5\nframes = 3\n"
        "[render]\nscatter_samples = 0\n"
    )
    scan(load_rig(folder / "scene.toml"), folder / "run")
    return folder / "run"


def test_a_run_folder_has_the_truth_of_each_of_its_frames(tmp_path: Path) -> None:
    """Without the scene file, at the recorded positions, with the recorded exposures."""
    run = recorded(tmp_path, "auto_exposure = true, target_dn = 150.0, max_ms = 1e4")
    (tmp_path / "scene.toml").unlink()
    done = CliRunner().invoke(app, ["truth", str(run), "-o", str(tmp_path / "truth")])
    assert done.exit_code == 0, done.output
    rows, opened = read(tmp_path / "truth" / "stripe.csv"), open_run(run)
    scene = scene_of(opened.rig_file)
    assert [row.exposure_ms for row in opened.rows] != [15.0] * 3
    for row in opened.rows:
        part = [entry for entry in rows if entry["frame"] == str(row.index)]
        truth = stripe_truth(scene, row.position_mm)
        (light,) = line_brightness(scene, [truth], [row.exposure_ms])
        assert {entry["position_mm"] for entry in part} == {repr(row.position_mm)}
        np.testing.assert_array_equal(column(part, "centre_px"), truth.centre_px)
        np.testing.assert_array_equal(column(part, "height_dn"), light.height_dn)


def scan_of_files(folder: Path) -> RigFile:
    """A scan of two pictures of a mesh with a texture over it."""
    trimesh.creation.box((60.0, 60.0, 20.0)).export(folder / "mesh.stl")
    cv2.imwrite(str(folder / "paint.png"), np.full((4, 4), 200, np.uint8))
    texture = {"file": "paint.png", "corner_mm": [-30.0, -30.0], "size_mm": [60.0, 60.0]}
    target = {"shape": "mesh", "file": "mesh.stl", "texture": texture}
    camera = {**BASE["camera"], "width_px": 64, "height_px": 48}
    lens = {"focal_px": 85.0, "centre_px": [31.5, 23.5]}
    over = {"camera": camera, "lens": lens, "target": target, "plan": {"frames": 2, "step_mm": 1.0}}
    render = {"samples": 1, "scatter_samples": 0}
    write_toml(folder / "scene.toml", merge(BASE, {**over, "render": render}))
    return load_rig(folder / "scene.toml")


@pytest.mark.parametrize("name", ["mesh.stl", "paint.png"])
def test_a_run_knows_its_files_by_what_they_held(tmp_path: Path, name: str) -> None:
    """Another mesh or texture of the same name neither goes on with the run nor judges it."""
    rig_file = scan_of_files(tmp_path)

    def stop(done: int, planned: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scan(rig_file, tmp_path / "run", progress=stop)
    run = open_run(tmp_path / "run")
    assert set(run.files) == {str(tmp_path / "mesh.stl"), str(tmp_path / "paint.png")}
    before = (tmp_path / name).read_bytes()
    trimesh.creation.box((60.0, 60.0, 40.0)).export(tmp_path / "mesh.stl")
    if name == "paint.png":
        scan_of_files(tmp_path)
        cv2.imwrite(str(tmp_path / "paint.png"), np.full((4, 4), 20, np.uint8))
    told = f"{tmp_path / name}: was changed since {tmp_path / 'run'} was made with it"
    with pytest.raises(InputError, match=told):
        scan(rig_file, tmp_path / "run", resume=True)
    with pytest.raises(InputError, match=told):
        taken_in(run)
    (tmp_path / name).unlink()
    with pytest.raises(InputError, match=f"{name}: is gone since"):
        taken_in(run)
    (tmp_path / name).write_bytes(before)
    whole = scan(rig_file, tmp_path / "run", resume=True)
    assert len(whole) == 2 and len(taken_in(whole)[1]) == 2


def test_a_process_that_helps_with_a_scan_later_does_not_load_another_mesh(tmp_path: Path) -> None:
    scene = scene_of(scan_of_files(tmp_path))
    files = named_files(scene.document)
    TankCamera(scene, files)
    (tmp_path / "mesh.stl").write_bytes(b"solid")
    with pytest.raises(InputError, match=r"mesh\.stl: was changed since"):
        TankCamera(scene, files)


def test_runs_without_truth_are_refused(tmp_path: Path) -> None:
    def said(*arguments: str) -> str:
        output = tmp_path / "truth"
        done = CliRunner().invoke(app, ["truth", *arguments, "-o", str(output)])
        assert isinstance(done.exception, InputError), done.output
        assert not output.exists()
        return str(done.exception)

    run = recorded(tmp_path)
    assert "a run folder has its own positions" in said(str(run), "--position", "3")
    (tmp_path / "empty").mkdir()
    assert "is not a run folder" in said(str(tmp_path / "empty"))
    real = parse_rig(
        {"camera": {"driver": "opencv"}, "track": {"driver": "manual"}}, source="a rig"
    )
    with create_run(tmp_path / "real", real):
        pass
    assert "was not made in the tank" in said(str(tmp_path / "real"))
    with create_run(tmp_path / "begun", open_run(run).rig_file):
        pass
    assert "holds no frame yet" in said(str(tmp_path / "begun"))


@pytest.mark.parametrize(("sigma_px", "fewest"), [(0.5, 1), (0.2, 9)])
def test_samples_farther_apart_than_the_line_is_wide_are_refused(
    sigma_px: float, fewest: int
) -> None:
    """Sums of a Gaussian at samples h apart, in closed form: within 5 % of its light from
    s / h = 0.432 on."""
    side = int(np.sqrt(fewest))
    for number, inside in ((side, True), (side - 1, False)):
        if number:
            rows = np.arange(-40, 40) / number
            share = np.exp(-(rows**2) / (2 * sigma_px**2)).sum() / number
            assert (abs(share / (sigma_px * np.sqrt(2 * np.pi)) - 1) <= 0.05) == inside
    scene = load_scene("paper/groove")
    (truth,) = (stripe_truth(scene, 100.0),)
    now = float(np.nanmedian(line_sigma_px(scene.with_tank(lens={"blur_px": 0.0}), truth)))
    wide = scene.tank.laser.waist_mm * sigma_px / now
    as_wide = scene.with_tank(laser={"waist_mm": wide, "waist_distance_mm": 600.0})
    check_sampling(as_wide, 100.0, fewest, "--samples")
    if side > 1:
        with pytest.raises(
            InputError, match=rf"--samples: samples lie .*allowed: {fewest} or more"
        ):
            check_sampling(as_wide, 100.0, (side - 1) ** 2, "--samples")
