"""Figures of a patch's roughness: its spectrum with band and cutoff, its plane, its rose."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lscan.figures.style import ACCENT, FIRST, HEIGHTS, MUTED, SECOND, WIDTH_IN, png, styled
from lscan.files.disk import make_folder, write_atomically
from lscan.roughness.analysis import Roughness
from lscan.roughness.instrument import ScannerResponse, noise_density
from lscan.roughness.patch import Patch
from lscan.roughness.spectra import by_rings

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
    rings, corrected, fit = by_rings(found.spectrum), by_rings(found.corrected), found.fit
    axes.fill_between(
        rings.wavenumber_per_cm, rings.low_cm4, rings.high_cm4, color=SECOND, alpha=0.2
    )
    axes.plot(rings.wavenumber_per_cm, rings.density_cm4, color=SECOND, label="measured, 95 %")
    known = corrected.wavenumber_per_cm <= found.cutoff_per_cm
    axes.plot(corrected.wavenumber_per_cm[known], corrected.density_cm4[known],
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
