"""An alignment kept in a file: the same to its covariance, strictly read, and used elsewhere."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrations import drawn_calibration
from covariance_example import surface_modes
from drawn_runs import rig_file
from synthetic_scans import Placing, scan

from lscan.config.targets import Sandwave
from lscan.errors import InputError
from lscan.pipeline import finish
from lscan.records import Floats, Provenance, Surface
from lscan.surface import Alignment, align_sandwave, apply
from lscan.surface.alignment import KeptAlignment, load_alignment, save_alignment
from lscan.surface.surface import provenance_of

PIECE = Sandwave()
PLACING = Placing(
    yaw_deg=2.2, turn_deg=-4.0, roll_deg=2.0, pitch_deg=-1.5, columns=320, frames=100, step_mm=2.0
)
ELSEWHERE = replace(PLACING, turn_deg=20.0, roll_deg=0.0, pitch_deg=0.0, z_mm=30.0, x_mm=10.0)
"""Another target on the same rig: the same yaw, and nothing else."""

MADE_FROM = Provenance("tank", 100, "ml", "refractive", "ab" * 32)


def known(placing: Placing, provenance: Provenance = MADE_FROM) -> Surface:
    """A scan with four modes of a calibration's error."""
    bare = scan(PIECE, placing)
    modes = surface_modes(bare)
    common = np.square(modes, dtype=float).sum(axis=-1)
    return replace(
        bare,
        modes_mm=modes,
        sigma_x_mm=np.sqrt(0.01**2 + common[..., 0]),
        sigma_z_mm=np.sqrt(0.02**2 + common[..., 2]),
        provenance=provenance,
    )


@pytest.fixture(scope="module")
def block() -> Surface:
    return known(PLACING)


@pytest.fixture(scope="module")
def found(block: Surface) -> Alignment:
    return align_sandwave(block, PIECE)


@pytest.fixture(scope="module")
def target() -> Surface:
    return known(ELSEWHERE)


@pytest.fixture(scope="module")
def saved(found: Alignment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("kept") / "alignment.json"
    save_alignment(path, found, MADE_FROM, PIECE)
    return path


def test_what_is_read_is_what_was_saved(found: Alignment, saved: Path) -> None:
    kept = load_alignment(saved)
    assert kept.provenance == MADE_FROM
    one, other = found, kept.alignment
    for name in ("rotation", "translation_mm", "pivot_mm", "left_corner_mm", "right_corner_mm"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.yaw_rad == pytest.approx(other.yaw_rad, rel=1e-15)
    assert one.yaw_sigma_rad == pytest.approx(other.yaw_sigma_rad, rel=1e-9)
    np.testing.assert_allclose(one.normal, other.normal, atol=1e-9)
    np.testing.assert_allclose(one.modes[:, :4], other.modes[:, :4], rtol=1e-12)
    covariance = one.modes @ one.modes.T
    np.testing.assert_allclose(
        other.modes @ other.modes.T, covariance, atol=1e-9 * np.abs(covariance).max()
    )


def test_the_surface_it_was_found_in_is_aligned_as_before(
    block: Surface, found: Alignment, saved: Path
) -> None:
    kept = load_alignment(saved)
    one, other = apply(found, block), apply(kept.of(block), block)
    np.testing.assert_allclose(one.xyz_mm, other.xyz_mm, atol=1e-10)
    np.testing.assert_allclose(one.sigma_z_mm, other.sigma_z_mm, rtol=1e-5)
    assert other.yaw_rad == pytest.approx(found.yaw_rad)
    assert other.yaw_sigma_rad == pytest.approx(found.yaw_sigma_rad)


def displaced(surface: Surface, amounts: Floats) -> Surface:
    assert surface.modes_mm is not None
    return replace(surface, xyz_mm=surface.xyz_mm + surface.modes_mm.astype(float) @ amounts)


@pytest.mark.parametrize("mode", [1, 3])
def test_a_mode_is_what_a_wrong_calibration_of_both_scans_gives(
    block: Surface, target: Surface, saved: Path, mode: int
) -> None:
    """Block and target displaced alike by one error, the block aligned anew."""
    amounts = np.eye(4)[mode]
    both = []
    for sign in (1.0, -1.0):
        again = align_sandwave(displaced(block, sign * amounts), PIECE)
        both.append(apply(again, displaced(target, sign * amounts)).xyz_mm)
    change = (both[0] - both[1]) / 2
    stated = apply(load_alignment(saved).of(target), target).modes_mm
    assert stated is not None
    seen = np.isfinite(change).all(axis=-1)
    off = (change - stated[..., mode])[seen]
    size = np.sqrt(np.mean(stated[seen][..., 2, mode].astype(float) ** 2))
    # Heights answer to first order in full, as in test_covariance.py; the target reaches twice
    # as far as the block's tops, over which a tilt is known.
    assert np.sqrt(np.mean(off[:, 2] ** 2)) < 0.3 * size + 1e-4


def test_with_another_calibration_the_errors_are_independent(target: Surface, saved: Path) -> None:
    kept = load_alignment(saved)
    other = replace(target, provenance=replace(MADE_FROM, calibration_sha256="cd" * 32))
    same, apart = kept.of(target), kept.of(other)
    assert same is kept.alignment
    assert apart.modes.shape == (7, 4 + 4 + 7)
    np.testing.assert_array_equal(apart.modes[:, :4], 0.0)
    np.testing.assert_allclose(apart.modes @ apart.modes.T, same.modes @ same.modes.T)
    assert kept.of(replace(target, provenance=None)).modes.shape == (7, 15)
    assert kept.of(replace(target, modes_mm=None)).modes.shape == (7, 11)
    aligned = apply(apart, other)
    assert aligned.modes_mm is not None and aligned.modes_mm.shape[-1] == 15


@pytest.mark.parametrize(
    "sections",
    [{"optics": {"water_index": [1.342, 0.001]}}, {"since_calibration": {"focal_percent": 0.1}}],
)
def test_another_water_or_a_changed_rig_counts_as_another_calibration(
    sections: dict[str, Any],
) -> None:
    plane_map = drawn_calibration("polynomial-3").plane_map
    one, same, other = (
        provenance_of(rig_file(**more).rig, 9, plane_map) for more in ({}, {}, sections)
    )
    assert one == same
    assert one.calibration_sha256 != other.calibration_sha256


def test_yaw_and_level_of_another_target_are_right_to_their_sigmas(
    target: Surface, saved: Path
) -> None:
    """The points of the other target where they truly lie, in the frame of the block."""
    aligned = apply(load_alignment(saved).of(target), target)
    truth = scan(PIECE, ELSEWHERE)
    yaw = np.radians(PLACING.yaw_deg)
    track = truth.xyz_mm[..., 1]
    head = truth.xyz_mm + np.stack(
        [track * np.sin(yaw), track * (np.cos(yaw) - 1), 0 * track], axis=-1
    )
    middle = np.array([PIECE.side_mm / 2, PIECE.side_mm / 2, 0.0])
    place = np.array([PLACING.x_mm, PLACING.y_mm, PLACING.z_mm])
    true = (head - place) @ PLACING.rotation() + middle
    error = aligned.xyz_mm - true
    seen = np.isfinite(error).all(axis=-1)
    assert aligned.sigma_y_mm is None
    for axis, sigma in ((0, aligned.sigma_x_mm), (2, aligned.sigma_z_mm)):
        assert np.abs(error[seen][:, axis]).max() < 3 * sigma[seen].max()


def test_it_is_not_used_for_a_scan_about_a_shaft(target: Surface, saved: Path) -> None:
    rig = rig_file(shaft={"point_mm": [0.0, 0.0, 300.0], "direction": [1.0, 0.0, 0.0]}).rig
    with pytest.raises(InputError, match="a kept alignment is that of a linear track"):
        finish(target, rig, load_alignment(saved))


def test_a_scan_about_a_shaft_keeps_nothing(found: Alignment, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a scan about a shaft has no yaw to keep"):
        save_alignment(tmp_path / "a.json", replace(found, sheared=False), MADE_FROM, PIECE)
    assert list(tmp_path.iterdir()) == []


def put(*keys: Any) -> Callable[[Any], None]:
    """Sets what the keys but the last lead to, to the last."""
    *path, key, value = keys

    def change(content: Any) -> None:
        for one in path:
            content = content[one]
        content[key] = value

    return change


BAD: dict[str, tuple[Callable[[Any], None], str]] = {
    "format": (put("format", "lscan-calibration"), "is no alignment"),
    "version": (put("version", 2), "version: must be"),
    "unknown key": (put("more", 1), "more: unknown key"),
    "source": (put("determined_from", "pictures", 0), "determined_from.pictures"),
    "digest": (put("determined_from", "calibration_sha256", "no"), "calibration_sha256"),
    "yaw": (put("yaw_deg", 90.0), "yaw_deg: must be"),
    "text": (put("yaw_deg", "2.2"), "yaw_deg: must be"),
    "no rotation": (put("rotation", 0, 0, 2.5), "rotation: must be a rotation"),
    "huge": (put("rotation", 0, 0, 1e300), "rotation: must be a rotation"),
    "rows": (put("rotation", [[1.0, 0.0], [0.0, 1.0]]), "rotation: must be a rotation"),
    "shift": (put("translation_mm", [1.0, 2.0]), "translation_mm: must be of length 3"),
    "far": (put("translation_mm", [1e9, 0.0, 0.0]), "translation_mm must hold no number above"),
    "asymmetric": (put("covariance", 0, 1, 5.0), "covariance must be symmetric"),
    "indefinite": (put("covariance", (np.eye(7) - 1.0 + np.eye(7)).tolist()), "none is below"),
    "size": (put("covariance", [[1.0]]), "covariance must be 7 by 7"),
    "modes": (put("by_calibration", [[1.0]]), "by_calibration: must be of length 7"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_one_clear_error(saved: Path, tmp_path: Path, kind: str) -> None:
    change, words = BAD[kind]
    content = json.loads(saved.read_text())
    change(content)
    path = tmp_path / "alignment.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        load_alignment(path)
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"format": "lscan-alignment"}', "NaN"])
def test_what_is_no_alignment_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        load_alignment(tmp_path / "a.json")


def test_a_kept_alignment_says_where_it_is_from(saved: Path) -> None:
    kept = load_alignment(saved)
    assert isinstance(kept, KeptAlignment)
    assert kept.source == "the block scanned with 'tank'"
