"""Calibration files of strangers: whatever they hold, they are read, or refused in one line."""

import copy
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from calibrations import drawn_calibration
from drawn_examples import examples
from hypothesis import given, strategies as st
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise
from peak_memory import refused_within

from lscan.calibration.calibrationfile import load_plane_map, save_calibration
from lscan.calibration.metric.solve import calibrate_metric
from lscan.errors import InputError, LscanError

pytestmark = pytest.mark.xdist_group("strange_calibrations")  # one worker: they share a fixture

MAPS = ("graticule-2", "graticule-bspline", "projective", "polynomial-4", "spline", "auto")
SIZES = (0, -1, 2.5, 1e308, -1e308, 1e-308, 1e30, -1e9, 10**30, 10**300, True, None)
SHAPES = ("x", "", "a\nb", [], {}, [[]], [1], {"a": 1}, [[1, 2], [3]], [[1e308, None, "x"]])


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The text of a good file of each kind."""
    import numpy as np

    folder = tmp_path_factory.mktemp("calibrations")
    for name in MAPS:
        save_calibration(folder / name, drawn_calibration(name))
    rig, rng = paper_rig(), np.random.default_rng(1)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng))]
    save_calibration(folder / "metric", calibrate_metric(views, known(rig), SIZE))
    return {file.name: file.read_text() for file in folder.iterdir()}


def change(data: st.DataObject, content: Any) -> None:
    """Replace, remove or add one value somewhere in the document."""
    keys = sorted(content) if isinstance(content, dict) else range(len(content))
    key = data.draw(st.sampled_from(keys), label="key")
    inner = content[key]
    if isinstance(inner, dict | list) and inner and data.draw(st.integers(0, 5), label="stop"):
        change(data, inner)
        return
    what = data.draw(st.sampled_from(["replace", "replace", "remove", "add"]), label="what")
    value = copy.deepcopy(data.draw(st.sampled_from(SIZES + SHAPES), label="value"))
    if what == "remove":
        del content[key]
    elif what == "add" and isinstance(content, list):
        content.append(value)
    else:
        content[key] = value


@pytest.mark.parametrize("name", [*MAPS, "metric"])
@examples(40)
@given(data=st.data())
def test_a_mutated_calibration_is_read_or_refused(
    saved: dict[str, str],
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    data: st.DataObject,
) -> None:
    document = json.loads(saved[name])
    for _ in range(data.draw(st.integers(1, 3), label="changes")):
        change(data, document)
    path = tmp_path_factory.getbasetemp() / "mutated.json"
    path.write_text(json.dumps(document))
    try:
        load_plane_map(path)
    except LscanError as error:
        assert path.name in str(error)
        assert "\n" not in str(error)


def test_a_map_that_is_flat_is_refused(saved: dict[str, str], tmp_path: Path) -> None:
    """Its Jacobian cannot be inverted."""
    document = json.loads(saved["polynomial-4"])
    document["parameters"]["coefficients"] = [[0.0] * 15] * 2
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"c\.json: residuals\.mm: do not belong"):
        load_plane_map(tmp_path / "c.json")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 10**6, "is not valid JSON: .*too deep in one another"),
        ('{"format":' * 900 + "1" + "}" * 900, "format.format.format...: .*too deep"),
        ('{"format": 1' + "0" * 10**6 + "}", "is not valid JSON"),
        ('{"format": "\\u0000"}', "format: holds a null character"),
        ('{"format": 1e999}', "is no calibration file"),
    ],
)
def test_json_that_exhausts_its_reader_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match=rf"c\.json: {said}") as caught:
        load_plane_map(tmp_path / "c.json")
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


@pytest.mark.parametrize("special", ["fifo", "device", "sparse", "folder"])
def test_what_is_no_plain_file_is_refused(tmp_path: Path, special: str) -> None:
    file = tmp_path / "c.json"
    if special == "fifo":
        os.mkfifo(file)
    elif special == "device":
        file.symlink_to("/dev/zero")
    elif special == "folder":
        file.mkdir()
    else:
        file.touch()
        os.truncate(file, 2**40)
    with pytest.raises(InputError, match=r"c\.json: (cannot be read: it is a|is too large: bytes)"):
        load_plane_map(file)


def test_a_file_takes_memory_in_proportion(tmp_path: Path) -> None:
    """Empty lists are what JSON is densest in: 3 bytes of text become 64 of memory.

    An empty list is 56 bytes and its place in the outer list 8; with the text itself, as bytes
    and decoded, that is 24 times the file, to which a fifth is added for the allocator.
    """
    count = 2**20
    (tmp_path / "c.json").write_text("[" + "[]," * count + "[]]")
    said, most_mib = refused_within(
        "from pathlib import Path\nfrom lscan.calibration.calibrationfile import load_plane_map\n"
        "import lscan.calibration.metric, lscan.calibration.calibrate",
        f"load_plane_map(Path({str(tmp_path / 'c.json')!r}))",
    )
    assert "c.json: is no calibration file" in said
    assert most_mib < 1.2 * 24 * 3


@pytest.mark.parametrize("name", ["of_a_stranger:solver", "of_a_stranger", "os:system"])
def test_a_calibration_names_installed_maps_only(
    saved: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "of_a_stranger.py").write_text("solver = None\n")
    monkeypatch.syspath_prepend(tmp_path)
    for key in ("plane_map", "chosen"):
        document = json.loads(saved["auto" if key == "chosen" else "graticule-2"])
        within = document["parameters"] if key == "chosen" else document
        within[key] = name
        (tmp_path / "c.json").write_text(json.dumps(document))
        with pytest.raises(InputError, match=r"c\.json: plane_map: .*no such family of plane maps"):
            load_plane_map(tmp_path / "c.json")
    assert "of_a_stranger" not in sys.modules


def test_a_correction_of_all_of_a_length_is_refused(saved: dict[str, str], tmp_path: Path) -> None:
    document = json.loads(saved["projective"])
    middle = {"middle_mm": [0.0, 0.0], "scale": -1.0}
    document["parameters"]["corrections"] = [middle]
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"c\.json: .*corrections\.0\.scale: must be .*-0\.5 to"):
        load_plane_map(tmp_path / "c.json")
