"""Phase functions against check values, with integrals done here by quadrature."""

from collections.abc import Callable

import numpy as np
from scipy.integrate import simpson

from lscan.figures import style
from lscan.figures.style import ReportFigure
from lscan.records import Floats
from sim.validation.physics.topics import page_figure, reference, topic
from sim.validation.rows import Row, Topic, row
from sim.water import FournierForand, HenyeyGreensteinMixture, PetzoldTable

Density = Callable[[Floats], Floats]

NARROWEST = 1e-9  # rad: where the integrals start; a peak of psi^-1.42 leaves 1e-5 within
REFERENCE = reference("phases")


def phases() -> Topic:
    """Values, mean cosines and backscattered shares of every phase function there is."""
    found = particles()
    return topic("phases", [*_value_rows(*found), *_integral_rows(*found)], (_figure(*found),))


def particles() -> tuple[Density, Density, Density]:
    """Densities in 1/sr of an angle in rad: Fournier-Forand's, the mixture, Petzold's table."""
    return (
        FournierForand(1.10, 3.5835).density,
        HenyeyGreensteinMixture().density,
        PetzoldTable().density,
    )


def _value_rows(fournier: Density, mixture: Density, petzold: Density) -> list[Row]:
    angles, table = np.array(REFERENCE["petzold"]).T
    at, values = np.array(REFERENCE["fournier"]).T
    ratio = mixture(np.radians(angles)) / table
    beyond = float(max(ratio.max() - 1.13, 0.91 - ratio.min(), 0.0))
    return [
        row("fournier-values", _relative(fournier(np.radians(at)), values)),
        row("fournier-smooth", _roughness(fournier)),
        row("petzold-values", _relative(petzold(np.radians(angles)), table)),
        row("lobes-over-petzold", beyond),
    ]


def _integral_rows(fournier: Density, mixture: Density, petzold: Density) -> list[Row]:
    backs = [
        abs(backscattered(FournierForand(n, slope).density) / share - 1)
        for n, slope, share in REFERENCE["backscatter"]
    ]
    rows = [row("fournier-backscatter", max(backs))]
    for case, density in zip(REFERENCE["moments"], (petzold, fournier, mixture), strict=True):
        total, mean = moments(density)
        off_g, off_back = mean / total - case["g"], backscattered(density) - case["back"]
        rows += [
            row("phase-integral", abs(total - 1), **case),
            row("phase-mean-cosine", abs(off_g), bar=case["bar_g"], **case),
            row("phase-backscatter", abs(off_back), bar=case["bar_back"], **case),
        ]
    return rows


def moments(density: Density) -> tuple[float, float]:
    """Integral of a phase function over the sphere, and of it times the cosine."""
    logarithm = np.linspace(np.log(NARROWEST), np.log(np.pi), 40001)
    angle = np.exp(logarithm)
    weight = 2 * np.pi * density(angle) * np.sin(angle) * angle
    return float(simpson(weight, x=logarithm)), float(simpson(weight * np.cos(angle), x=logarithm))


def backscattered(density: Density) -> float:
    """Share of the light scattered by more than 90 degrees."""
    angle = np.linspace(np.pi / 2, np.pi, 4001)
    return float(simpson(2 * np.pi * density(angle) * np.sin(angle), x=angle))


def _relative(found: Floats, values: Floats) -> float:
    return float(np.abs(found / values - 1).max())


def _roughness(density: Density) -> float:
    """How far the curve near 9.94 degrees leaves the quintic through its surroundings.

    There the literal formula divides two differences that vanish (index 1.10).  The quintic
    is fitted to the logarithm over one degree with the middle left out.
    """
    critical = 2 * np.degrees(np.arcsin(np.sqrt(0.75 * 0.10**2)))
    offset = np.linspace(-0.5, 0.5, 2001)
    value = np.log(density(np.radians(critical + offset)))
    inner = np.abs(offset) < 0.3
    curve = np.polynomial.Polynomial.fit(offset[~inner], value[~inner], 7)
    return float(np.abs(value - curve(offset))[inner].max())


@style.styled
def _figure(fournier: Density, mixture: Density, petzold: Density) -> ReportFigure:
    figure, (upper, lower) = style.panels(2, (style.WIDTH_IN, 4.2), heights=(3.0, 1.4))
    angles, table = np.array(REFERENCE["petzold"]).T
    fine = np.geomspace(0.1, 180, 600)
    curves = {"four lobes": (mixture, style.FIRST), "Fournier–Forand": (fournier, style.SECOND)}
    for name, (density, colour) in curves.items():
        upper.plot(fine, density(np.radians(fine)), color=colour, label=name)
        ratio = density(np.radians(fine)) / petzold(np.radians(fine))
        lower.plot(fine, ratio, color=colour)
    upper.plot(angles, table, "o", color=style.INK, markersize=3, label="Petzold")
    upper.set_xscale("log")
    upper.set_yscale("log")
    upper.set_ylabel("phase function / sr⁻¹")
    lower.axhline(1, color=style.MUTED, linewidth=0.8)
    lower.set_ylabel("over Petzold")
    lower.set_xlabel("scattering angle / degrees")
    style.legend(upper)
    return page_figure("phases", figure)
