"""`lscan roughness` as its users run it: on a surface of a known law and a known train."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from command_line import call, refused
from netcdf_forms import stumbling_blocks
from rough_patches import drawn, wave

from lscan.errors import MeasurementError
from lscan.records import Status, Surface
from lscan.roughness import PowerLaw, patch_of_cells, patch_of_profiles
from lscan.surface import load_surface, save_surface

SIDE, CELL_CM = 64, 0.2
LAW = PowerLaw(w2_cm4=1e-3, gamma2=3.0)


@pytest.fixture(scope="module")
def surface_file(tmp_path_factory):
    """Rough ground with ripples of 3.2 cm, heading 0, of an amplitude of 5 mm."""
    heights, _ = drawn(LAW, (SIDE, SIDE), CELL_CM, seed=4)
    heights = heights + wave((SIDE, SIDE), CELL_CM, 4.0, 0.0, 0.5)
    y, x = np.mgrid[:SIDE, :SIDE] * CELL_CM
    xyz_mm = 10 * np.stack([x, y, heights], axis=-1)
    sigma, status = np.full(heights.shape, 0.01), np.full(heights.shape, int(Status.OK))
    surface = Surface(xyz_mm, sigma, sigma, status, xyz_mm[:, 0, 1], "workpiece")
    file = tmp_path_factory.mktemp("rough") / "surface.nc"
    save_surface(file, surface)
    return file


def test_the_file_holds_every_spectrum_and_their_variances_agree(surface_file, tmp_path, capsys):
    """The integral of a spectrum is a variance: that of W1 along x holds the ripples.

    Half a wave apart the ripples differ by twice the square of their amplitude in the mean, a whole
    wave apart not at all; what the ground adds grows with the distance where gamma2 is 3, so that
    half of that of a whole wave takes it off.  10 %: the patch has four waves, and the ground a
    fifth of their power.
    """
    output = tmp_path / "roughness.nc"
    code, out, _ = call(capsys, "roughness", surface_file, "-o", output, "--json")
    assert code == 0
    told = json.loads(out)
    assert told["ripple_wavelength_cm"] == pytest.approx(3.2, rel=0.01)
    assert 0 <= told["ripple_spread"] < 0.02
    assert stumbling_blocks(output) == []
    with xr.open_dataset(output, engine="h5netcdf") as found:
        for name in ("w1_x", "w1_y", "w1_x_capon", "w1_y_capon"):
            assert (found[name] > 0).all(), name
        along = found["w1_x"]
        power = 2 * float(along.sum()) * float(np.diff(along.kx_profile)[0])
        assert power == pytest.approx(told["rms_height_cm"] ** 2, rel=0.1)
        for name in ("w1_x", "w1_x_capon"):
            peak = float(found[name].kx_profile[int(found[name].values.argmax())])
            assert peak == pytest.approx(2 * np.pi / 3.2, rel=0.3)
        structure = found["structure_x"]
        half, whole = structure.interp(distance_x=[1.6, 3.2]).values
        assert half - whole / 2 == pytest.approx(2 * 0.5**2, rel=0.1)
        assert found.attrs["gamma2"] == told["gamma2"]


def test_blur_that_was_corrected_for_is_not_divided_out_again(
    surface_file, tmp_path, capsys, monkeypatch
):
    """What the command takes the scanner to pass, which test_linereading.py holds to its closed
    form: of a corrected line more of all waves of 8 to 16 pixels, so that less is added to them.

    Rings of two fits need not be in that order one by one: each is the fitted law times how far the
    patch is off its expectation, and law, leakage and differences are others.
    """
    corrected = tmp_path / "corrected.nc"
    done = replace(load_surface(surface_file), corrections=("blur of 0.7 px",))
    save_surface(corrected, done)
    told = []

    def response_alone(patch, response, **options):
        told.append(response)
        raise MeasurementError("no more is asked")

    monkeypatch.setattr("lscan.roughness.roughness_of", response_alone)
    for file, *options in (
        (corrected,), (corrected, "--pixel", 2), (surface_file, "--pixel", 2, "--blur", 1.4)
    ):  # fmt: skip
        assert "no more is asked" in call(capsys, "roughness", file, *options)[2]
    lengths = [(one.blur_cm, one.pixel_cm, one.corrected_px) for one in told]
    expected = [(0.0, 0.0, 0.0), (0.14, 0.2, 0.7), (0.14, 0.2, 0.0)]
    np.testing.assert_allclose(lengths, expected)
    refused(call(capsys, "roughness", corrected, "--blur", 1.4), "--pixel", "0.7 px")


@pytest.mark.slow  # test_linereading.py has what a rig says
def test_a_rig_says_what_is_averaged_over(surface_file, tmp_path, capsys):
    """Its pixels are the points' distance; it is of surfaces in the head's frame."""
    head = tmp_path / "head.nc"
    save_surface(head, replace(load_surface(surface_file), frame="head"))
    found = []
    for options in (("--rig", "paper/board"), ("--pixel", 2.0)):
        code, out, _ = call(capsys, "roughness", head, *options, "--json")
        assert code == 0
        found.append(json.loads(out))
    assert found[0]["gamma2"] == pytest.approx(found[1]["gamma2"], abs=1e-6)
    refused(call(capsys, "roughness", head, "--rig", "best/sandwave"), "peak_dn")
    refused(call(capsys, "roughness", head, "--rig", "paper/board", "--pixel", 2), "--rig")
    refused(call(capsys, "roughness", surface_file, "--rig", "paper/board"), "head frame")


@pytest.mark.parametrize("points", [0, 1, 7])
def test_a_profile_of_few_points_is_a_hole(surface_file, points):
    """One of 64 that cannot be joined to a curve: a frame without a line, or with little of it."""
    surface = load_surface(surface_file)
    status = surface.status.copy()
    status[20, points:] = Status.NO_PEAK
    xyz_mm = np.where((status == Status.OK)[..., np.newaxis], surface.xyz_mm, np.nan)
    patch = patch_of_profiles(replace(surface, xyz_mm=xyz_mm, status=status))
    assert np.flatnonzero(~patch.seen.any(axis=1)).tolist() == [20]
    assert patch.seen.mean() == pytest.approx(63 / 64)


@pytest.mark.parametrize("cell", ["1", "2", "40"])
def test_cells_that_are_too_small_or_too_few_name_a_size_that_serves(surface_file, capsys, cell):
    """Points 2 mm apart: nine lie in a cell of 6 mm, of which 21 lie side by side."""
    code, _, err = call(capsys, "roughness", surface_file, "--cell", cell)
    assert code == 1
    found = re.search(r"a cell needs 9 points: cells of ([\d.]+) mm serve", err)
    assert found is not None
    assert float(found[1]) == pytest.approx(6.0, rel=0.1)
    assert patch_of_cells(load_surface(surface_file), float(found[1])).seen.mean() >= 0.5


def test_a_surface_too_small_for_any_cells_says_so(surface_file):
    small = load_surface(surface_file)
    cut = {name: getattr(small, name)[:30, :30] for name in ("xyz_mm", "sigma_x_mm", "status")}
    small = replace(small, sigma_z_mm=cut["sigma_x_mm"], position_mm=small.position_mm[:30], **cut)
    with pytest.raises(MeasurementError, match=r"9 points: no size of cells serves"):
        patch_of_cells(small, 2.0)


def test_what_does_not_fit_is_refused(surface_file, tmp_path, capsys):
    refused(call(capsys, "roughness", surface_file, "--cell", "0"), "is not a length")
    refused(call(capsys, "roughness", surface_file, "--yaw", "50"), "is not a yaw")
    refused(call(capsys, "roughness", surface_file, "--frequency", "30"), "--sediment")
    refused(call(capsys, "roughness", surface_file, "--sediment", "moon dust"), "moon dust")
