"""What the tank's commands refuse, as a scan does: options, files, and impossible geometry."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from places import SCENES
from typer.testing import CliRunner

from lscan.config.rig import load_rig
from lscan.errors import InputError
from sim.cli.app import app

SMALL = (
    "[camera]\nwidth_px = 64\nheight_px = 48\n[lens]\nfocal_px = 85.0\ncentre_px = [31.5, 23.5]\n"
)


def write_scene(folder: Path, text: str, base: str = "paper/groove.toml") -> Path:
    """A scene file that lays ``text`` over one of the gallery's."""
    path = folder / "scene.toml"
    path.write_text(f'include = "{SCENES / base}"\n{text}')
    return path


def refusal(command: str, scene: Path) -> str:
    """The message of the InputError that the command ends in, its output not begun."""
    output = scene.parent / "out"
    done = CliRunner().invoke(app, [command, str(scene), "-o", str(output)])
    assert isinstance(done.exception, InputError), done.output
    assert not output.exists()
    return str(done.exception)


@pytest.mark.parametrize(
    ("command", "text", "message"),
    [
        ("render", "[camera.options]\nzoom = true\n", "camera.options.zoom: unknown key"),
        ("truth", "[camera.options]\nmin_ms = -1.0\n", "camera.options.min_ms: must be"),
        ("views", "[track.options]\nmin_mm = 5\nmax_mm = 1\n", "track.options: min_mm must be"),
    ],
)
def test_options_are_checked_as_in_a_scan(
    tmp_path: Path, command: str, text: str, message: str
) -> None:
    scene = write_scene(tmp_path, text)
    with pytest.raises(InputError) as scanned:
        load_rig(scene)
    said = refusal(command, scene)
    assert said == str(scanned.value)
    assert said.startswith(f"{scene}: {message}")


def test_a_render_is_exposed_as_a_scan_s_picture_is(tmp_path: Path) -> None:
    """With auto exposure its brightest pixel comes to the target, whatever the rig says."""
    options = "auto_exposure = true\ntarget_dn = 120.0\npercentile = 100.0\nmax_ms = 1e4\n"
    text = (
        f"{SMALL}[camera.options]\n{options}"
        + "[sensor]\nnoise = false\n[render]\nscatter_samples = 0\n"
    )
    for power_mw in (2.0, 20.0):
        scene = write_scene(tmp_path, f"{text}[laser]\npower_mw = {power_mw}\n")
        done = CliRunner().invoke(app, ["render", str(scene), "-o", str(tmp_path / "out")])
        assert done.exit_code == 0, done.output
        picture = cv2.imread(str(tmp_path / "out" / "picture.png"))
        assert abs(int(picture.max()) - 120) <= 1  # rounding to whole DN


def text_mesh(folder: Path) -> str:
    (folder / "stone.ply").write_text("not a mesh")
    return '[target]\nshape = "mesh"\nfile = "stone.ply"\n'


def empty_mesh(folder: Path) -> str:
    (folder / "stone.stl").write_bytes(b"")
    return '[target]\nshape = "mesh"\nfile = "stone.stl"\n'


def missing_mesh(folder: Path) -> str:
    return '[target]\nshape = "mesh"\nfile = "stone.obj"\n'


def points_only(folder: Path) -> str:
    trimesh.PointCloud(np.eye(3)).export(folder / "stone.ply")
    return '[target]\nshape = "mesh"\nfile = "stone.ply"\n'


def text_texture(folder: Path) -> str:
    (folder / "paper.png").write_text("not a picture")
    return '[target.texture]\nfile = "paper.png"\nsize_mm = [10.0, 10.0]\n'


def texture_over_colours(folder: Path) -> str:
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.full((8, 4), 200, np.uint8)
    mesh.export(folder / "stone.ply")
    picture = SCENES / "targets" / "checks.png"
    return (
        '[target]\nshape = "mesh"\nfile = "stone.ply"\n'
        f'[target.texture]\nfile = "{picture}"\nsize_mm = [10.0, 10.0]\n'
    )


@pytest.mark.parametrize(
    ("make", "key", "message"),
    [
        (text_mesh, "target.file", "stone.ply: has no header from 'ply' to"),
        (empty_mesh, "target.file", "stone.stl: is an empty file"),
        (missing_mesh, "target.file", "no such file"),
        (points_only, "target.file", "stone.ply: "),
        (text_texture, "target.texture.file", "paper.png: is not a picture that can be read"),
        (texture_over_colours, "target.texture", "does not go with a mesh that has vertex colours"),
    ],
)
def test_errors_of_files_name_scene_and_key(
    tmp_path: Path, make: Callable[[Path], str], key: str, message: str
) -> None:
    scene = write_scene(tmp_path, make(tmp_path))
    said = refusal("truth", scene)
    assert said.startswith(f"{scene}: {key}")
    assert message in said
    assert "\n" not in said
