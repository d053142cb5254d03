"""All that is asked of a patch's roughness, in the order in which each needs the last."""

from contextlib import suppress
from dataclasses import asdict, dataclass
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lscan.errors import MeasurementError
from lscan.figures.style import ACCENT, FIRST, HEIGHTS, MUTED, SECOND, WIDTH_IN, png, styled
from lscan.files.containers import NetcdfArray, netcdf_bytes
from lscan.files.disk import make_folder, write_atomically
from lscan.records import Floats, Progress
from lscan.roughness.instrument import (
    ScannerResponse,
    corrected_spectrum,
    cutoff_per_cm,
    noise_density,
)
from lscan.roughness.patch import Patch
from lscan.roughness.ripples import (
    RippleSpread,
    RippleTrain,
    find_ripples,
    ripple_spread,
    without_ripples,
)
from lscan.roughness.spectra import (
    PatchSpectrum,
    ProfileSpectrum,
    RoughnessMoments,
    by_rings,
    capon_spectrum,
    detrend,
    moments,
    patch_spectrum,
    profile_spectrum,
    structure_function,
)
from lscan.roughness.whittle import Band, PowerLawFit, fit_power_law, most_likely_law, usable_band
from lscan.version import __version__

RIPPLES = (
    "wavelength_cm", "heading_deg", "height_cm",
    "sigma_wavelength_cm", "sigma_heading_deg", "sigma_height_cm",
)  # fmt: skip


@dataclass(frozen=True)
class Roughness:
    """The roughness of a patch.

    Attributes
    ----------
    moments : RoughnessMoments
    ripples : RippleTrain or None, the train that stands out
    spread : RippleSpread or None, of that train
    fit : PowerLawFit, of what is left without it, up to the cutoff
    cutoff_per_cm : float, rad/cm, beyond it the instrument is measured
    spectrum : PatchSpectrum, W2 as measured, ripples included
    corrected : PatchSpectrum, the same less the noise, over what the instrument passes
    """

    moments: RoughnessMoments
    ripples: RippleTrain | None
    spread: RippleSpread | None
    fit: PowerLawFit
    cutoff_per_cm: float
    spectrum: PatchSpectrum
    corrected: PatchSpectrum

    def figures(self) -> dict[str, float]:
        """The numbers by name, units in the names; _sigma: standard uncertainty.

        low and high are the ends of a 95 % interval.  lack_of_fit: how many times wider intervals
        are for what the law does not fit.
        """
        fit, law = self.fit, self.fit.law
        w2_db = 10 * log10(law.w2_cm4)
        reach, reach_db = fit.within * fit.sigma_gamma2, fit.within * fit.sigma_w2_db
        found = {
            "gamma2": law.gamma2,
            "gamma2_low": law.gamma2 - reach,
            "gamma2_high": law.gamma2 + reach,
            "w2_cm4": law.w2_cm4,
            "w2_low_cm4": 10 ** ((w2_db - reach_db) / 10),
            "w2_high_cm4": 10 ** ((w2_db + reach_db) / 10),
            "band_low_per_cm": fit.band.low_per_cm,
            "band_high_per_cm": fit.band.high_per_cm,
            "cutoff_per_cm": self.cutoff_per_cm,
            "lack_of_fit": fit.lack,
            **asdict(self.moments),
        }
        if law.stretch != (0.0, 0.0):
            found |= {"stretch_ratio": law.ratio, "stretch_heading_deg": law.heading_deg}
        if self.ripples is not None:
            ripples = asdict(self.ripples)
            found |= {f"ripple_{name}": ripples[name] for name in RIPPLES}
        if self.spread is not None:
            found["ripple_spread"] = self.spread.relative
            found["ripple_spread_heading_deg"] = self.spread.heading_deg
        return found


def roughness_of(
    patch: Patch,
    response: ScannerResponse | None = None,
    *,
    stretched: bool = False,
    seed: int = 1,
    progress: Progress | None = None,
) -> Roughness:
    """Moments, ripples, power law and cutoff of a patch.

    Parameters
    ----------
    patch : Patch, cm
    response : ScannerResponse, optional; by default one that takes nothing away
    stretched : bool, whether the power law may differ between directions
    seed : int, of the simulated patches that intervals come from
    progress : Progress or None, called with (done, all) after each of those

    Raises
    ------
    MeasurementError
        The patch is too small, too noisy, or has no power law.

    Examples
    --------
    >>> import numpy as np
    >>> from lscan.roughness import Patch, roughness_of
    >>> y, x = np.mgrid[:40, :40] * 0.2
    >>> rough = np.random.default_rng(0).standard_normal(x.shape).cumsum(0).cumsum(1) * 0.005
    >>> patch = Patch(rough + 0.3 * np.cos(2 * np.pi * x / 2.0), np.full(x.shape, True), 0.2)
    >>> ripples = roughness_of(patch).ripples
    >>> round(ripples.wavelength_cm, 1), round(ripples.height_cm, 1)
    (2.0, 0.6)
    """
    response = response or ScannerResponse()
    train = find_ripples(patch, response=response)
    rest = patch if train is None else without_ripples(patch, train)
    spread = None if train is None else ripple_spread(patch, train)
    told: dict[str, Any] = {
        "stretched": stretched, "response": response, "known": response.known
    }  # fmt: skip
    cutoff = cutoff_per_cm(most_likely_law(rest, **told), rest, response)
    usable = usable_band(rest)
    band = Band(usable.low_per_cm, min(usable.high_per_cm, cutoff))
    fit = fit_power_law(rest, band=band, seed=seed, progress=progress, **told)
    spectrum = patch_spectrum(patch)
    corrected = corrected_spectrum(spectrum, patch, response)
    return Roughness(moments(patch), train, spread, fit, cutoff, spectrum, corrected)


# The NetCDF file of a patch's roughness.


UNHELD = "none where leakage and folding are expected to be more than all else"
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
    plane, rings = found.spectrum, found.fit.rings
    assert rings.seabed_cm4 is not None
    arrays = {
        "w2": _array(("ky", "kx"), plane.density_cm4, "cm4", "roughness spectrum"),
        "w2_ring": _array(
            ("k",), rings.density_cm4, "cm4",
            "mean over rings, less ripples and what leaks and folds in",
        ),
        "w2_ring_corrected": _array(
            ("k",), rings.seabed_cm4, "cm4", "its mean over rings, less noise, over the response"
        ),
        "w2_ring_low": _array(("k",), rings.low_cm4, "cm4", f"lower 95 % limit; {UNHELD}"),
        "w2_ring_high": _array(("k",), rings.high_cm4, "cm4", f"upper 95 % limit; {UNHELD}"),
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
    heights, seen = detrend(patch), patch.seen
    if axis == 0:
        heights, seen = heights.T, seen.T
    count = heights.shape[1]
    size: Floats = 2 * np.pi * np.fft.rfftfreq(count, patch.cell_cm).astype(float)[1:]
    with suppress(MeasurementError):  # too few stretches are without a hole
        found["Capon"] = capon_spectrum(heights, seen, patch.cell_cm, size, count // CAPON)
    return found


# Figures of a patch's roughness: its spectrum with band and cutoff, its plane, its rose.


SHOWN_DB = 60.0


def save_figures(folder: Path, patch: Patch, found: Roughness, response: ScannerResponse) -> None:
    """Write spectrum.png, plane.png and rose.png.

    Parameters
    ----------
    folder : Path, made where it is missing
    patch : Patch
    found : Roughness, of it
    response : ScannerResponse, it was found with

    Raises
    ------
    InputError
        A file cannot be written.
    """
    make_folder(folder)
    drawn = {
        "spectrum": draw_spectrum(patch, found, response),
        "plane": draw_plane(found),
        "rose": draw_rose(found),
    }
    for name, figure in drawn.items():
        write_atomically(folder / f"{name}.png", png(figure))


@styled
def draw_spectrum(patch: Patch, found: Roughness, response: ScannerResponse) -> Figure:
    """W2 over rings of wavenumbers: measured, fitted, the instrument's noise, and the cutoff.

    Parameters
    ----------
    patch : Patch
    found : Roughness, of it
    response : ScannerResponse, it was found with
    """
    figure = Figure(figsize=(WIDTH_IN, 3.6), layout="constrained")
    axes = figure.add_subplot()
    whole, fit = by_rings(found.spectrum), found.fit
    axes.plot(whole.wavenumber_per_cm, whole.density_cm4, color=MUTED, linewidth=0.8,
              label="with ripples and leakage")  # fmt: skip
    rings = fit.rings
    assert rings.seabed_cm4 is not None
    axes.fill_between(
        rings.wavenumber_per_cm, rings.low_cm4, rings.high_cm4, color=SECOND, alpha=0.2
    )
    axes.plot(rings.wavenumber_per_cm, rings.density_cm4, color=SECOND,
              label="without, 95 %")  # fmt: skip
    known = rings.wavenumber_per_cm <= found.cutoff_per_cm
    axes.plot(rings.wavenumber_per_cm[known], rings.seabed_cm4[known],
              color=ACCENT, label="less noise, over the response")  # fmt: skip
    size = np.geomspace(fit.band.low_per_cm, fit.band.high_per_cm, 100)
    law = fit.law.density(0 * size, size)
    axes.plot(size, law, color=FIRST, label=f"power law, $\\gamma_2$ = {fit.law.gamma2:.2f}")
    passed = response(size, 0 * size)
    axes.plot(size, law * passed + noise_density(patch), color=FIRST, linestyle=":",
              label="as the instrument shows it")  # fmt: skip
    if patch.noise_cm2 > 0:
        axes.axhline(noise_density(patch), color=MUTED, linestyle="--", label="noise")
    if found.cutoff_per_cm < patch.nyquist_per_cm:
        axes.axvline(found.cutoff_per_cm, color=ACCENT, label="cutoff")
    axes.set(xscale="log", yscale="log", xlabel="wavenumber, rad/cm", ylabel="$W_2$, cm$^4$")
    axes.legend(loc="lower left", fontsize=7)
    return figure


@styled
def draw_plane(found: Roughness) -> Figure:
    """W2 over the plane of wavenumbers, dB below its largest value.

    Parameters
    ----------
    found : Roughness
    """
    figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained")
    axes = figure.add_subplot()
    spectrum = found.spectrum
    level_db = 10 * np.log10(np.maximum(spectrum.density_cm4 / spectrum.density_cm4.max(), 1e-30))
    x, y = spectrum.along_x_per_cm.ravel(), spectrum.along_y_per_cm.ravel()
    drawn = axes.pcolormesh(x, y, level_db, cmap=HEIGHTS, vmin=-SHOWN_DB, vmax=0, rasterized=True)
    figure.colorbar(drawn, ax=axes, label="dB")
    axes.set(xlabel="along x, rad/cm", ylabel="along y, rad/cm", aspect="equal")
    return figure


@styled
def draw_rose(found: Roughness) -> Figure:
    """The share of the mean slope's square by direction: across which way crests run.

    Parameters
    ----------
    found : Roughness
    """
    figure = Figure(figsize=(WIDTH_IN, 4.0), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    spectrum = found.spectrum
    y, x = np.broadcast_arrays(spectrum.along_y_per_cm, spectrum.along_x_per_cm)
    size = np.hypot(y, x)
    # The corners beyond Nyquist's circle are seen in some directions alone.
    power = np.where(size < -spectrum.along_y_per_cm.min(), spectrum.density_cm4 * size**2, 0.0)
    edges = np.linspace(-np.pi, np.pi, 37)
    share, _ = np.histogram(np.arctan2(y, x), edges, weights=power)
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    axes.bar(middle, share / max(float(share.sum()), 1e-300), width=width, color=SECOND)
    axes.set_title("share of the mean square slope, direction from x", fontsize=9)
    return figure
