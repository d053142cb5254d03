"""The NetCDF file of a patch's roughness."""

import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import xarray as xr

from lscan.errors import MeasurementError
from lscan.files.disk import write_atomically
from lscan.records import Floats
from lscan.roughness.analysis import Roughness
from lscan.roughness.moments import structure_function
from lscan.roughness.patch import Patch
from lscan.roughness.spectra import (
    ProfileSpectrum,
    RingSpectrum,
    by_rings,
    capon_spectrum,
    detrended,
    profile_spectrum,
)
from lscan.version import __version__

CAPON = 4  # stretches of a profile: as short as a wave of which the profile has four


def save_roughness(path: Path, patch: Patch, found: Roughness) -> None:
    """Write spectra and structure functions to a NetCDF-4 file, the numbers to its attributes.

    W2 of the plane and its mean over rings; along x and along y W1 of the profiles by multitaper
    and, for short stretches, by Capon, where enough of them are without a hole, and the structure
    function.

    Parameters
    ----------
    path : Path
    patch : Patch
    found : Roughness, of it

    Raises
    ------
    InputError
        The file cannot be written.
    """
    plane, rings, corrected = found.spectrum, by_rings(found.spectrum), by_rings(found.corrected)
    per_cm, cm4 = {"units": "rad cm-1"}, {"units": "cm4"}
    data = xr.Dataset(
        {
            "w2": (("ky", "kx"), plane.density_cm4, {**cm4, "long_name": "roughness spectrum"}),
            "w2_ring": ("k", rings.density_cm4, {**cm4, "long_name": "its mean over rings"}),
            "w2_ring_corrected": (
                "k",
                _at(rings.wavenumber_per_cm, corrected),
                {**cm4, "long_name": "its mean over rings, less noise, over the response"},
            ),
            "w2_ring_low": ("k", rings.low_cm4, {**cm4, "long_name": "lower 95 % limit"}),
            "w2_ring_high": ("k", rings.high_cm4, {**cm4, "long_name": "upper 95 % limit"}),
        },
        coords={
            "ky": ("ky", plane.along_y_per_cm.ravel(), per_cm),
            "kx": ("kx", plane.along_x_per_cm.ravel(), per_cm),
            "k": ("k", rings.wavenumber_per_cm, per_cm),
        },
        attrs={**found.figures(), "Conventions": "CF-1.11", "source": f"lscan {__version__}"},
    )
    data = data.assign({name: one for axis in (0, 1) for name, one in _along(patch, axis).items()})
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "roughness.nc"
        data.to_netcdf(whole, engine="h5netcdf")
        content = whole.read_bytes()
    write_atomically(path, content)


def _along(patch: Patch, axis: int) -> dict[str, xr.DataArray]:
    """Spectra of the profiles along an axis, and the structure function, by their names."""
    name = "yx"[axis]
    structure = structure_function(patch, axis)
    found = {
        f"structure_{name}": xr.DataArray(
            structure.difference_cm2,
            {f"distance_{name}": structure.distance_cm},
            attrs={"units": "cm2", "long_name": f"structure function along {name}"},
        )
    }
    with suppress(MeasurementError):  # every profile has a hole
        whole = profile_spectrum(patch, axis)
        found[f"w1_{name}"] = _profiles(whole, name, "multitaper")
    heights, seen = detrended(patch), patch.seen
    if axis == 0:
        heights, seen = heights.T, seen.T
    count = heights.shape[1]
    size: Floats = 2 * np.pi * np.fft.rfftfreq(count, patch.cell_cm).astype(float)[1:]
    with suppress(MeasurementError):  # too few stretches are without a hole
        short = capon_spectrum(heights, seen, patch.cell_cm, size, count // CAPON)
        found[f"w1_{name}_capon"] = _profiles(short, name, "Capon")
    return found


def _profiles(spectrum: ProfileSpectrum, name: str, method: str) -> xr.DataArray:
    return xr.DataArray(
        spectrum.density_cm3,
        {f"k{name}_profile": spectrum.wavenumber_per_cm},
        attrs={"units": "cm3", "long_name": f"W1 of profiles along {name}, two-sided, by {method}"},
    )


def _at(wavenumber_per_cm: Floats, rings: RingSpectrum) -> Floats:
    """Rings at wavenumbers of other rings, NaN beyond: some rings have no value that is known."""
    known = rings.wavenumber_per_cm, rings.density_cm4
    return np.asarray(np.interp(wavenumber_per_cm, *known, left=np.nan, right=np.nan))
