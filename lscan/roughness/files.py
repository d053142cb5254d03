"""The NetCDF file of a patch's roughness."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from lscan.errors import MeasurementError
from lscan.files.containers import NetcdfArray, netcdf_bytes
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
    arrays = {
        "w2": _array(("ky", "kx"), plane.density_cm4, "cm4", "roughness spectrum"),
        "w2_ring": _array(("k",), rings.density_cm4, "cm4", "its mean over rings"),
        "w2_ring_corrected": _array(
            ("k",), _at(rings.wavenumber_per_cm, corrected), "cm4",
            "its mean over rings, less noise, over the response",
        ),
        "w2_ring_low": _array(("k",), rings.low_cm4, "cm4", "lower 95 % limit"),
        "w2_ring_high": _array(("k",), rings.high_cm4, "cm4", "upper 95 % limit"),
        "ky": _wavenumbers("ky", plane.along_y_per_cm.ravel(), "wavenumber along y"),
        "kx": _wavenumbers("kx", plane.along_x_per_cm.ravel(), "wavenumber along x"),
        "k": _wavenumbers("k", rings.wavenumber_per_cm, "wavenumber of the ring"),
        **_along(patch, 0),
        **_along(patch, 1),
    }  # fmt: skip
    notes = {"title": "Roughness of a surface", "source": f"lscan {__version__}", **found.figures()}
    write_atomically(path, netcdf_bytes(arrays, notes))


def _array(dimensions: tuple[str, ...], values: Floats, unit: str, long_name: str) -> NetcdfArray:
    return NetcdfArray(dimensions, values, {"units": unit, "long_name": long_name})


def _wavenumbers(name: str, values: Floats, long_name: str) -> NetcdfArray:
    return _array((name,), values, "rad cm-1", long_name)


def _along(patch: Patch, axis: int) -> dict[str, NetcdfArray]:
    """Spectra of the profiles along an axis, and the structure function, by their names."""
    name = "yx"[axis]
    structure, distance, k = structure_function(patch, axis), f"distance_{name}", f"k{name}_profile"
    values, words = structure.difference_cm2, f"structure function along {name}"
    found = {
        f"structure_{name}": _array((distance,), values, "cm2", words),
        distance: _array((distance,), structure.distance_cm, "cm", f"distance along {name}"),
    }
    for method, spectrum in _profile_spectra(patch, axis).items():
        words = f"W1 of profiles along {name}, two-sided, by {method}"
        ending = "" if method == "multitaper" else "_capon"
        found[f"w1_{name}{ending}"] = _array((k,), spectrum.density_cm3, "cm3", words)
        found[k] = _wavenumbers(k, spectrum.wavenumber_per_cm, f"wavenumber along {name}")
    return found


def _profile_spectra(patch: Patch, axis: int) -> dict[str, ProfileSpectrum]:
    """Those that the patch's holes allow, by method, at the same wavenumbers."""
    found = {}
    with suppress(MeasurementError):  # every profile has a hole
        found["multitaper"] = profile_spectrum(patch, axis)
    heights, seen = detrended(patch), patch.seen
    if axis == 0:
        heights, seen = heights.T, seen.T
    count = heights.shape[1]
    size: Floats = 2 * np.pi * np.fft.rfftfreq(count, patch.cell_cm).astype(float)[1:]
    with suppress(MeasurementError):  # too few stretches are without a hole
        found["Capon"] = capon_spectrum(heights, seen, patch.cell_cm, size, count // CAPON)
    return found


def _at(wavenumber_per_cm: Floats, rings: RingSpectrum) -> Floats:
    """Rings at wavenumbers of other rings, NaN beyond: some rings have no value that is known."""
    known = rings.wavenumber_per_cm, rings.density_cm4
    return np.asarray(np.interp(wavenumber_per_cm, *known, left=np.nan, right=np.nan))
