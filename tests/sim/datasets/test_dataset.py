"""Data sets: their truth, the same bytes however they are made, bad specs, and reading them."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from places import ROOT
from truth_scenes import BASE, tank
from typer.testing import CliRunner

from lscan.config.documents import merge, write_toml
from lscan.errors import DiskError, InputError
from lscan.files.datasets import MEMBERS, MOST_PICTURES, PictureDataset, run_lengths
from lscan.records import Status
from sim.cli.app import app
from sim.datasets import dataset as making
from sim.datasets.dataset import Format, ShardTask, kept_record, make_dataset, packed_shard
from sim.datasets.datasetspec import load_dataset_spec
from sim.datasets.labels import Label
from sim.render.tank import Tank, surfaces_seen
from sim.scene import camera_pose, head_pose, load_scene
from sim.truth import project, stripe_truth

SMALL = {
    "camera": {"width_px": 64, "height_px": 48},
    "lens": {"focal_px": 85.0, "centre_px": [31.5, 23.5]},
    "floor": {"z_mm": -100.0},
    "render": {"samples": 1, "scatter_samples": 0},
}
DRAWN = {
    "power": {"key": "laser.power_mw", "uniform": [5.0, 15.0]},
    "place": {"key": "plan.position_mm", "uniform": [0.0, 5.0]},
    "floor": {"key": "floor.z_mm", "uniform": [-120.0, -80.0]},
}
SPEC = {"name": "small", "scenes": ["scene.toml"], "seed": 7, "tank_pictures": 2, "drawn": DRAWN}
COUNT = 5


def spec_file(folder: Path, **over: Any) -> Path:
    write_toml(folder / "scene.toml", merge(BASE, SMALL))
    write_toml(folder / "spec.toml", {**SPEC, **over})
    return folder / "spec.toml"


def made(folder: Path, name: str, form: Format = "webdataset", **options: Any) -> Path:
    spec = load_dataset_spec(spec_file(folder))
    make_dataset(spec, folder / name, COUNT, form=form, **{"workers": "none", **options})
    return folder / name


def content(folder: Path) -> dict[str, bytes]:
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five pictures, made in this process."""
    return made(tmp_path_factory.mktemp("dataset"), "alone")


@pytest.mark.parametrize(
    ("turn", "lens", "fineness"),
    [(0.0, {}, 1), (25.0, {}, 1), (0.0, {"focus_mm": 300.0, "f_number": 1.0}, 2)],
)
def test_depth_and_normals_are_those_of_a_plane(
    turn: float, lens: dict[str, float], fineness: int
) -> None:
    """The floor, z = -100 mm: a pixel's point is on it, is seen there, and has its normal.

    Rays are in single precision: 24 bits of a metre are 6e-5 mm, ten operations of them and the
    slant of the ray (1.5 at most) 1e-3 mm, which at 85 px and 900 mm is 1e-4 px.  The camera's
    inversion of a flat port is iterated to 1e-3 px of such a picture.
    """
    head = {"turn_deg": [0.0, 0.0, turn], "depression_deg": 40.0}
    render = {"fineness": fineness, "samples": 4}
    scene = tank(**merge(SMALL, {"head": head, "lens": lens, "render": render}))
    found = surfaces_seen(Tank(scene), 3.0)
    head = scene.tank.head
    camera = camera_pose(head)
    world = head_pose(head, 3.0) @ camera
    assert np.isfinite(found.depth_mm).all()
    assert np.abs(found.normals - world.rotation[2]).max() < 1e-6
    # What a pixel sees is seen in its middle, by the truth's own projection; single precision.
    seen = project(scene, camera.apply(found.points_mm.reshape(-1, 3)))
    v, u = np.indices(found.depth_mm.shape)
    np.testing.assert_allclose(seen, np.column_stack([u.ravel(), v.ravel()]), atol=1e-3)
    # Points with that depth which project to the pixels: by the truth's own projection the
    # floor's points are found in pixels, and the depth there is theirs.
    x, y = np.meshgrid(np.linspace(-60, 60, 7), np.linspace(-30, 30, 5))
    on_floor = np.column_stack([x.ravel(), y.ravel() + 3.0, np.full(x.size, -100.0)])
    in_camera = world.invert(on_floor)
    pixels = project(scene, head_pose(head, 3.0).invert(on_floor))
    inside = ((pixels > 0) & (pixels < [63, 47])).all(axis=1)
    assert inside.sum() >= 8
    u, v = pixels[inside].T
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    # Between four pixels the inverse of a plane's depth is bilinear but for distortion by the port.
    inverse, a, b = 1 / found.depth_mm, u - left, v - top
    between = (1 - b) * ((1 - a) * inverse[top, left] + a * inverse[top, left + 1])
    between += b * ((1 - a) * inverse[top + 1, left] + a * inverse[top + 1, left + 1])
    # What the port bends within a pixel: depth changes by up to 15 mm a pixel, in which its
    # direction departs from a pinhole's by 1e-3 of a pixel at most.
    assert np.abs(1 / between - in_camera[inside, 2]).max() < 0.02


def test_where_nothing_is_seen_there_is_no_depth() -> None:
    scene = tank(**{**SMALL, "floor": {"z_mm": -100.0}, "head": {"depression_deg": -60.0}})
    found = surfaces_seen(Tank(scene), 0.0)
    assert np.isnan(found.points_mm).all()
    assert np.isnan(found.normals).all()


def test_a_picture_has_the_truth_of_its_own_scene(alone: Path) -> None:
    dataset = PictureDataset(alone)
    dataset.verify()
    assert len(dataset) == COUNT
    spec = load_dataset_spec(alone.parent / "spec.toml")
    for number in range(COUNT):
        found = dataset[number]
        base, _ = spec.tank(number // 2)
        scene, drawn = spec.picture(base, number)
        assert found.scene["drawn"].items() >= drawn.items()
        truth = stripe_truth(scene, drawn["plan.position_mm"])
        assert np.array_equal(found.truth["status"][0], truth.status)
        okay = truth.status == Status.OK
        assert np.array_equal(found.truth["centre_px"][0][okay], truth.centre_px[okay])
        for name in ("centre_px", "width_px", "height_dn"):
            assert np.array_equal(np.isfinite(found.truth[name][0]), okay)
        assert found.picture.shape == (48, 64, 3)
        for label in Label:
            assert found.scene["rle"][label.name] == run_lengths(found.labels == label)
    own = {found.scene["tank"]["floor"]["z_mm"] for found in map(dataset.__getitem__, range(5))}
    assert len(own) == 3  # a tank of two, of two, and of one picture


def test_a_picture_has_the_truth_of_its_own_place(tmp_path: Path) -> None:
    """Over a ramp along the track, on which each place has a line of its own."""
    spec_file(tmp_path)
    ramp = trimesh.creation.box((400.0, 400.0, 20.0))
    ramp.apply_transform(trimesh.transformations.rotation_matrix(0.3, (1, 0, 0)))
    ramp.export(tmp_path / "ramp.stl")
    target = {"shape": "mesh", "file": "ramp.stl", "position_mm": [0.0, 0.0, -60.0]}
    write_toml(tmp_path / "scene.toml", merge(merge(BASE, SMALL), {"target": target}))
    spec = load_dataset_spec(tmp_path / "spec.toml")
    make_dataset(spec, tmp_path / "set", 1, workers="none")
    scene, drawn = spec.picture(spec.tank(0)[0], 0)
    truth, start = (stripe_truth(scene, mm) for mm in (drawn["plan.position_mm"], 0.0))
    seen = (truth.status == Status.OK) & (start.status == Status.OK)
    assert np.count_nonzero(truth.centre_px[seen] != start.centre_px[seen]) > 10
    found = PictureDataset(tmp_path / "set")[0]
    assert np.array_equal(found.truth["centre_px"][0][seen], truth.centre_px[seen])


def test_pictures_do_not_depend_on_how_many_there_are(tmp_path: Path, alone: Path) -> None:
    spec = load_dataset_spec(spec_file(tmp_path))
    make_dataset(spec, tmp_path / "two", 2, workers="none")
    first = "shard-000000.tar"
    assert (tmp_path / "two" / first).read_bytes() == (alone / first).read_bytes()


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(tmp_path: Path, alone: Path) -> None:
    assert content(made(tmp_path, "two", workers=2)) == content(alone)


@pytest.mark.parametrize("form", ["hdf5", "folders"])
def test_all_formats_hold_the_same(tmp_path: Path, alone: Path, form: Format) -> None:
    other = PictureDataset(made(tmp_path, form, form))
    other.verify()
    for number, picture in enumerate(PictureDataset(alone)[k] for k in range(COUNT)):
        assert other[number] == picture


@pytest.mark.slow
def test_a_killed_data_set_goes_on_with_the_same_bytes(tmp_path: Path, alone: Path) -> None:
    """Killed once the first shard is there; the torn file of the next is a stranger's."""
    command = ["dataset", str(spec_file(tmp_path)), "-o", str(tmp_path / "set"), "--count", "5"]
    command += ["--processes", "none"]
    process = subprocess.Popen(
        [sys.executable, "-m", "sim.cli.app", *command], stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "set" / "shard-000000.json").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    for torn in ("shard-000001.tar", ".shard-000001.tar.0123abcd.tmp"):
        (tmp_path / "set" / torn).write_bytes(b"torn")
    refused = CliRunner().invoke(app, command)
    assert isinstance(refused.exception, InputError)
    assert CliRunner().invoke(app, [*command, "--resume"]).exit_code == 0
    assert content(tmp_path / "set") == content(alone)


@pytest.mark.parametrize("form", ["webdataset", "hdf5", "folders"])
def test_what_ends_a_shard_costs_the_picture_under_way_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: Format
) -> None:
    """Of 4 pictures of one tank the second fails, and the third is ended; then it goes on."""
    spec = load_dataset_spec(spec_file(tmp_path, tank_pictures=4))
    shown: list[str] = []

    def pictures(ended: int | None) -> None:
        def picture(tank: object, scene: object, drawn: object) -> dict[str, bytes]:
            shown.append(str(len(shown)))
            if len(shown) == 2:
                raise InputError("no such picture")
            if len(shown) == ended:
                raise KeyboardInterrupt
            return {name: f"{name} {drawn}".encode() for name in MEMBERS}

        shown.clear()
        monkeypatch.setattr(making, "picture_files", picture)

    pictures(None)
    whole = make_dataset(spec, tmp_path / "whole", 4, form=form, workers="none")
    assert whole["failed"] == {"000000001": "no such picture"}
    pictures(3)
    with pytest.raises(KeyboardInterrupt):
        make_dataset(spec, tmp_path / "set", 4, form=form, workers="none")
    shutil.copytree(tmp_path / "set", tmp_path / "killed")
    make_dataset(spec, tmp_path / "set", 4, form=form, workers="none", resume=True)
    assert len(shown) == 3 + 2
    assert content(tmp_path / "set") == content(tmp_path / "whole")
    # Where it killed its workers time and again, what they had made is kept.
    record = packed_shard(ShardTask(spec, tmp_path / "killed", form, 0, 0, 4), "killed its worker")
    assert record.keys == ("000000000",)
    assert list(record.failed.values()) == ["no such picture", *["killed its worker"] * 2]


@pytest.mark.parametrize("form", ["webdataset", "hdf5"])
def test_memory_holds_a_picture_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: Format
) -> None:
    """Of 12 pictures of 4 MB: three copies at most, of one and its archive, and of the next."""
    size = 1 << 20
    monkeypatch.setattr(making, "picture_files", lambda *_: dict.fromkeys(MEMBERS, b"1" * size))
    spec = load_dataset_spec(spec_file(tmp_path, tank_pictures=12))
    make_dataset(spec, tmp_path / "first", 1, form=form, workers="none")  # what is made once
    tracemalloc.start()
    make_dataset(spec, tmp_path / "set", 12, form=form, workers="none")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3.5 * len(MEMBERS) * size


@pytest.mark.parametrize("form", ["webdataset", "hdf5", "folders"])
def test_a_shard_without_a_picture_is_not_written(tmp_path: Path, form: Format) -> None:
    """Its record says why; the readers of WebDataset take an empty archive for a harmed one."""
    task = ShardTask(load_dataset_spec(spec_file(tmp_path)), tmp_path, form, 0, 0, 2)
    record = packed_shard(task, "killed its worker")
    assert record.failed == dict.fromkeys(task.keys, "killed its worker")
    assert not (tmp_path / task.file).exists()
    assert kept_record(task) == record


def test_a_scene_that_fails_is_a_row_of_the_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A uniform number beyond its key's range in the outermost 5 % alone passes the first look."""
    drawn = {"exposure": {"key": "camera.exposure_ms", "values": [-1.0, 20.0, 20.0]}}
    drawn["exposure"]["weights"] = [1.0, 20.0, 20.0]  # type: ignore[assignment]
    spec = load_dataset_spec(spec_file(tmp_path, drawn=drawn, tank_pictures=100, seed=66))
    number = next(n for n in range(9) if np.isnan(_exposure(spec, n)))
    found = make_dataset(spec, tmp_path / "set", number + 1, workers="none")
    assert list(found["failed"]) == [f"{number:09d}"]
    assert "camera.exposure_ms" in found["failed"][f"{number:09d}"]
    assert len(PictureDataset(tmp_path / "set")) == number


def _exposure(spec: Any, number: int) -> float:
    try:
        return float(spec.picture(spec.scenes[0], number)[0].rig.camera.exposure_ms)
    except InputError:
        return float("nan")


@pytest.mark.parametrize(
    ("over", "named"),
    [
        ({"drawn": {"a": {"key": "laser.powr", "fixed": 1.0}}}, "laser.powr"),
        ({"drawn": {"a": {"key": "laser.power_mw", "uniform": [-5.0, 5.0]}}}, "power_mw"),
        ({"drawn": {k: {"key": "floor.z_mm", "fixed": -90.0} for k in "ab"}}, "drawn twice"),
        ({"drawn": {"a": {"key": "light.ambient_w_m2_sr", "fixed": 1.0}}}, "ambient"),
        ({"scenes": ["no-such-scene"]}, "no-such-scene"),
    ],
)
def test_bad_specs_are_refused(tmp_path: Path, over: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError) as refused:
        load_dataset_spec(spec_file(tmp_path, **over))
    assert named in str(refused.value)


def test_another_data_set_is_not_overwritten(tmp_path: Path, alone: Path) -> None:
    other = load_dataset_spec(spec_file(tmp_path, seed=8))
    for resume, why in ((False, "holds a data set"), (True, "holds another data set")):
        with pytest.raises(InputError, match=why):
            make_dataset(other, alone, COUNT, workers="none", resume=resume)


def test_a_data_set_that_was_refused_is_not_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where no scheduler answers: nothing was made, so nothing is to be gone on with."""

    def refused(*_: Any) -> Any:
        raise InputError("no scheduler answers")

    monkeypatch.setattr(making, "open_workers", refused)
    for seed in (7, 8):
        spec = load_dataset_spec(spec_file(tmp_path, seed=seed))
        with pytest.raises(InputError, match="no scheduler answers"):
            make_dataset(spec, tmp_path / "set", COUNT, scheduler="tcp://127.0.0.1:9")


def test_more_pictures_than_can_be_read_again_are_not_begun(tmp_path: Path) -> None:
    spec = load_dataset_spec(spec_file(tmp_path))
    with pytest.raises(InputError, match="too many pictures"):
        make_dataset(spec, tmp_path / "set", MOST_PICTURES + 1)
    assert not (tmp_path / "set").exists()


def test_another_mesh_of_the_same_name_is_another_data_set(tmp_path: Path) -> None:
    """Wherever the mesh lies: what it holds counts."""
    file = spec_file(tmp_path)
    scene = merge(BASE, {**SMALL, "target": {"shape": "mesh", "file": "mesh.stl"}})
    write_toml(tmp_path / "scene.toml", scene)
    box = trimesh.creation.box((60.0, 60.0, 20.0))
    box.export(tmp_path / "mesh.stl")
    make_dataset(load_dataset_spec(file), tmp_path / "set", 1, workers="none")
    kept = json.loads((tmp_path / "set" / "identity.json").read_text(encoding="utf-8"))
    assert list(kept["files_sha256"]) == ["mesh.stl"]
    (tmp_path / "moved").mkdir()
    for name in ("spec.toml", "scene.toml", "mesh.stl"):
        (tmp_path / "moved" / name).write_bytes((tmp_path / name).read_bytes())
    moved = load_dataset_spec(tmp_path / "moved" / "spec.toml")
    make_dataset(moved, tmp_path / "set", 1, workers="none", resume=True)
    trimesh.creation.box((60.0, 60.0, 40.0)).export(tmp_path / "mesh.stl")
    changed = load_dataset_spec(file)
    with pytest.raises(InputError, match=r"differs in its files_sha256\.mesh"):
        make_dataset(changed, tmp_path / "set", 1, workers="none", resume=True)


def test_a_shard_whose_bit_flipped_is_made_again(tmp_path: Path, alone: Path) -> None:
    shutil.copytree(alone, tmp_path / "set")
    shard = tmp_path / "set" / "shard-000002.tar"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    made(tmp_path, "set", resume=True)
    assert content(tmp_path / "set") == content(alone)


def test_a_shard_that_the_disk_has_no_room_for_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(to: Path, files: object) -> None:
        to.write_bytes(b"half of it")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setitem(making.WRITERS, "webdataset", full)
    pictures = dict.fromkeys(MEMBERS, b"one")
    monkeypatch.setattr(making, "picture_files", lambda *_: pictures)
    with pytest.raises(DiskError, match="make room"):
        made(tmp_path, "set")
    assert list((tmp_path / "set").glob(".*")) == list((tmp_path / "set").glob("*.tar")) == []


def test_a_bit_that_flipped_is_noticed(tmp_path: Path, alone: Path) -> None:
    for name, data in content(alone).items():
        (tmp_path / name).write_bytes(data)
    shard = tmp_path / "shard-000001.tar"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    with pytest.raises(InputError, match=r"hash differs.*shard-000001|shard-000001.*hash differs"):
        PictureDataset(tmp_path).verify()


def test_pictures_are_read_side_by_side(alone: Path) -> None:
    """By eight threads, each picture forty times: none reads where another one left off."""
    dataset = PictureDataset(alone)
    expected = [dataset[number] for number in range(COUNT)]
    with ThreadPoolExecutor(8) as pool:
        numbers = [number for _ in range(40) for number in range(COUNT)]
        for number, found in zip(numbers, pool.map(dataset.__getitem__, numbers), strict=True):
            assert found == expected[number]


def test_a_scene_that_is_no_json_is_refused_by_its_picture(alone: Path) -> None:
    harmed = replace(PictureDataset(alone)[1], members={"scene.json": b"{"})
    with pytest.raises(InputError, match=r"picture 000000001: scene\.json: is not valid JSON"):
        harmed.scene  # noqa: B018 - decoded when it is asked for


def test_the_data_card_says_what_was_drawn(alone: Path) -> None:
    card = (alone / "README.md").read_text(encoding="utf-8")
    for said in (
        "`laser.power_mw` | uniform 5 to 15 | picture",
        "`floor.z_mm`",
        "Licence",
        "seed 7",
    ):
        assert said in card
    assert json.loads((alone / "manifest.json").read_text(encoding="utf-8"))["pictures"] == COUNT


def test_the_loader_of_the_page_loads(alone: Path) -> None:
    pytest.importorskip("torch")
    page = (ROOT / "docs" / "howto" / "make-a-data-set.md").read_text(encoding="utf-8")
    code = page.rpartition("```python\n")[2].partition("```")[0]
    found: dict[str, Any] = {}
    exec(code.replace("out/dataset", str(alone)).replace("num_workers=2", "num_workers=0"), found)
    pictures, labels = next(iter(found["loader"]))
    assert pictures.shape == (COUNT, 3, 48, 64) and labels.shape == (COUNT, 48, 64)


def test_the_spec_that_comes_with_lscan_is_sound() -> None:
    assert load_dataset_spec("stripes").scenes[0].rig.name == load_scene("paper/groove").rig.name
