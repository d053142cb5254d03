"""`lscan roughness` as its users run it: on a surface of a known law and a known train."""

import json

import numpy as np
import pytest
import xarray as xr
from command_line import call, refused
from rough_patches import drawn, wave

from lscan.records import Status, Surface
from lscan.roughness import PowerLaw
from lscan.surface import save_surface

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


def test_what_does_not_fit_is_refused(surface_file, tmp_path, capsys):
    refused(call(capsys, "roughness", surface_file, "--cell", "0"), "is no length")
    refused(call(capsys, "roughness", surface_file, "--yaw", "50"), "is no yaw")
    refused(call(capsys, "roughness", surface_file, "--frequency", "30"), "--sediment")
    refused(call(capsys, "roughness", surface_file, "--sediment", "moon dust"), "moon dust")
