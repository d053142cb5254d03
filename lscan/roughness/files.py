"""The NetCDF file of a patch's roughness."""

import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from lscan.files.disk import write_atomically
from lscan.records import Floats
from lscan.roughness.analysis import Roughness
from lscan.roughness.spectra import RingSpectrum, by_rings
from lscan.version import __version__


def save_roughness(path: Path, found: Roughness) -> None:
    """Write spectra to a NetCDF-4 file, and what was found of them to its attributes.

    Parameters
    ----------
    path : Path
    found : Roughness

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
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "roughness.nc"
        data.to_netcdf(whole, engine="h5netcdf")
        content = whole.read_bytes()
    write_atomically(path, content)


def _at(wavenumber_per_cm: Floats, rings: RingSpectrum) -> Floats:
    """Rings at wavenumbers of other rings, NaN beyond: some rings have no value that is known."""
    known = rings.wavenumber_per_cm, rings.density_cm4
    return np.asarray(np.interp(wavenumber_per_cm, *known, left=np.nan, right=np.nan))
