"""The wheel in a clean environment and an empty folder: nothing of the checkout is needed."""

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from built_package import build_wheel, clean, install
from places import ROOT, tracked
from suite_cases import drawn_suite

import lscan
from lscan.suites import pack_suite

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("package")]

TINY = "[render]\nsamples = 1\nscatter_samples = 0\n[plan]\nframes = 1\n"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def programs(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(wheel, tmp_path_factory.mktemp("with-tank"))


@pytest.fixture(scope="module")
def without_tank(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(wheel, tmp_path_factory.mktemp("without-tank"), tank=False)


def call(folder: Path, program: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """A program run in a folder, as somebody without the checkout runs it."""
    command = [str(program), *map(str, arguments)]
    return subprocess.run(command, cwd=folder, env=clean(), capture_output=True, text=True)


def test_the_wheel_holds_every_file_of_the_packages_and_the_scenes(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    assert {path.split("/")[0] for path in packed} == {
        "lscan",
        "sim",
        f"lscan-{lscan.__version__}.dist-info",
    }
    for top, prefix in (("lscan", ""), ("sim", ""), ("scenes", "lscan/")):
        for path in tracked(ROOT / top):
            assert f"{prefix}{path.relative_to(ROOT).as_posix()}" in packed


def test_from_the_scenes_to_a_surface_in_an_empty_folder(programs: Path, tmp_path: Path) -> None:
    listed = call(tmp_path, programs / "lscan", "scenes", "--copy", "mine", "--json")
    assert listed.returncode == 0, listed.stderr
    assert "paper/sandwave" in json.loads(listed.stdout)["scenes"]
    for name in ("board", "groove"):
        text = f'include = "mine/paper/{name}.toml"\n{TINY}'
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    scanned = call(tmp_path, programs / "lscan", "scan", "board.toml", "-o", "board")
    assert scanned.returncode == 0, scanned.stderr
    code = """if True:
        import lscan
        calibration = lscan.calibrate_run(lscan.open_run("board"), "graticule-2")
        run = lscan.scan(lscan.load_rig("groove.toml"), "groove")
        surface = lscan.reconstruct(run, calibration.plane_map).surface
        lscan.save_surface("surface.nc", surface)
        print(lscan.__file__, surface.status.shape)"""
    done = call(tmp_path, programs / "python", "-c", code)
    assert done.returncode == 0, done.stderr
    file, _, shape = done.stdout.strip().partition(" ")
    assert Path(file).is_relative_to(programs.parent)
    assert shape == "(1, 640)"
    assert (tmp_path / "surface.nc").is_file()


def test_two_wheels_and_a_strangers_are_all_that_a_regression_test_needs(
    without_tank: Path, tmp_path: Path
) -> None:
    """lscan without the tank, a suite's wheel, and the example as a wheel with its own tests.

    What those tests say without a baseline, or of a worse extractor, test_plugin tells.
    """
    (tmp_path / "twelve").mkdir()
    drawn_suite(tmp_path / "twelve", 12, "twelve")
    pack_suite(tmp_path / "twelve", tmp_path / "twelve.zip")
    packed = call(tmp_path, without_tank / "lscan", "suite", "wheel", "twelve.zip", "-o", "dist")
    assert packed.returncode == 0, packed.stderr
    example = shutil.copytree(ROOT / "examples" / "line-finder", tmp_path / "line-finder")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", tmp_path / "dist"]
    subprocess.run([*build, example], env=clean(), check=True, capture_output=True, text=True)
    wheels = sorted((tmp_path / "dist").glob("*.whl"))
    assert [file.name.split("-")[0] for file in wheels] == ["line_finder", "lscan_suites"]
    pip = [sys.executable, "-m", "pip", "--python", without_tank / "python", "install", "--quiet"]
    subprocess.run([*pip, "--no-deps", "--no-index", *wheels], check=True, env=clean())

    listed = call(tmp_path, without_tank / "lscan", "suite", "list", "--json")
    place = Path(json.loads(listed.stdout)["twelve"])
    assert place.is_relative_to(without_tank.parent)
    bench = ["bench", "line_finder:find_line", "--only", "--suite", "twelve", "-o", "b", "--json"]
    judged = call(tmp_path, without_tank / "lscan", *bench)
    assert judged.returncode == 0, judged.stderr
    assert list(json.loads(judged.stdout)["extractors"]) == ["line_finder:find_line"]

    shutil.rmtree(example / "src")  # what is tested is what is installed
    pytest_there = [without_tank / "python", "-m", "pytest", "-q", "--lscan-suite", "twelve"]
    for options in (["--lscan-update"], []):
        program, *rest = [*pytest_there, *options]
        done = call(example, program, *rest)
        assert done.returncode == 0, done.stdout
    assert "13 passed" in done.stdout


def test_the_tanks_commands_find_the_scenes_by_name(programs: Path, tmp_path: Path) -> None:
    done = call(tmp_path, programs / "lscan-sim", "truth", "paper/groove", "-o", "truth")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "truth" / "stripe.csv").is_file()


def test_the_instrument_works_without_the_tank(without_tank: Path, tmp_path: Path) -> None:
    drawn = call(tmp_path, without_tank / "lscan", "draw-board", "paper/board", "-o", "board.svg")
    assert drawn.returncode == 0, drawn.stderr
    rig = """camera = { driver = "opencv", options = { device = 0 } }
    track = { driver = "manual", options = { min_mm = 0, max_mm = 10 } }"""
    (tmp_path / "rig.toml").write_text(rig, encoding="utf-8")
    code = """if True:
        import lscan
        from lscan.benchmark.run import registered_extractors
        from lscan.stripe import find_extractor
        print(lscan.load_rig("rig.toml").rig.camera.driver)
        print(*(find_extractor(name).__name__ for name in registered_extractors()))"""
    driver, found = call(tmp_path, without_tank / "python", "-c", code).stdout.splitlines()
    assert driver == "opencv" and len(found.split()) == 9


@pytest.mark.parametrize(
    "command",
    ["lscan scan paper/board -o run", "lscan-sim render paper/board -o run", "lscan-sim demo"],
)
def test_without_the_tank_one_line_says_what_to_install(
    without_tank: Path, tmp_path: Path, command: str
) -> None:
    program, *arguments = command.split()
    done = call(tmp_path, without_tank / program, *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install 'lscan[tank]'" in done.stderr
    assert not list(tmp_path.iterdir())
