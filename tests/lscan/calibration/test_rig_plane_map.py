"""A plane map that is not there is refused when the rig is read, before any scan."""

from pathlib import Path
from typing import Any

import pytest

import lscan.config.rig
from lscan.calibration.planemap import find_solver
from lscan.config.rig import RigFile, load_rig
from lscan.errors import InputError

RIG = """
camera = {{ driver = "opencv", options = {{ device = 0 }} }}
track = {{ driver = "manual", options = {{ min_mm = 0, max_mm = 300 }} }}
calibration = {{ plane_map = "{name}" }}
"""

GOOD = (
    *("projective", "spline", "auto", "refractive", "polynomial-1", "polynomial-9"),
    *("graticule-1", "graticule-2", "graticule-bspline", "graticule-2-norulers"),
)
BAD = {
    "polynomial-99": "polynomial-1, polynomial-2",
    "polynomial-0": "polynomial-1, polynomial-2",
    "polynomial-²": "polynomial-1, polynomial-2",
    "polynomial": "polynomial-1, polynomial-2",
    "graticule-3": "graticule-1, graticule-1-norulers, graticule-2",
    "graticule-norulers": "graticule-1",
    "graticule": "graticule-1",
    "projective-2": "projective",
    "spline-": None,
    "spline-3": "spline",
    "auto-2": "auto",
    "refractive-1": "refractive",
    "metric": "calibrate-metric",
    "cubic-2": "graticule",
}


def read(folder: Path, name: str) -> RigFile:
    (folder / "rig.toml").write_text(RIG.format(name=name))
    return load_rig(folder / "rig.toml")


@pytest.mark.parametrize("name", GOOD)
def test_a_map_that_is_there_is_taken(tmp_path: Path, name: str) -> None:
    assert read(tmp_path, name).rig.calibration.plane_map == name


@pytest.mark.parametrize("name", [name for name, allowed in BAD.items() if allowed])
def test_a_map_that_is_not_there_is_named_with_its_key(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, name)
    line = str(caught.value)
    assert "rig.toml: calibration.plane_map: " in line
    assert repr(name) in line or name.partition("-")[0] == "cubic"
    assert f"allowed: {BAD[name]}" in line or BAD[name] in line.partition("allowed: ")[2]


@pytest.mark.parametrize("name", [name for name in BAD if name != "cubic-2"])
def test_the_rig_refuses_no_less_than_the_solver(tmp_path: Path, name: str) -> None:
    """What ``solve`` would refuse for its name is refused here; a bare hyphen says nothing."""
    named = find_solver(name)
    try:
        named.solver.check_variant(named.variant)  # type: ignore[attr-defined]
    except InputError:
        with pytest.raises(InputError):
            read(tmp_path, name)
    else:
        assert name == "spline-"
        read(tmp_path, name)


def test_a_strangers_solver_without_the_check_still_serves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = lscan.config.rig.find_plugin

    def with_stranger(group: str, name: str, where: object = None) -> Any:
        return object() if name == "stranger" else original(group, name, where)

    monkeypatch.setattr(lscan.config.rig, "find_plugin", with_stranger)
    assert read(tmp_path, "stranger-7").rig.calibration.plane_map == "stranger-7"
