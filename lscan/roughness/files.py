"""The NetCDF file of a patch's roughness."""

import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from lscan.files.disk import write_atomically
from lscan.roughness.analysis import Roughness
from lscan.roughness.patch import Patch
from lscan.roughness.spectra import patch_spectrum
from lscan.version import __version__


def save_roughness(path: Path, patch: Patch, found: Roughness) -> None:
    """Write spectra to a NetCDF-4 file, and what was found of them to its attributes.

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
    plane, rings = patch_spectrum(patch), found.rings
    corrected = found.corrected.wavenumber_per_cm, found.corrected.density_cm4
    per_cm, cm4 = {"units": "rad cm-1"}, {"units": "cm4"}
    data = xr.Dataset(
        {
            "w2": (("ky", "kx"), plane.density_cm4, {**cm4, "long_name": "roughness spectrum"}),
            "w2_ring": ("k", rings.density_cm4, {**cm4, "long_name": "its mean over rings"}),
            "w2_ring_corrected": (
                "k",
                np.interp(rings.wavenumber_per_cm, *corrected, left=np.nan, right=np.nan),
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
