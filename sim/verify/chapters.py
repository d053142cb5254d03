"""The chapters of the evidence, in the order of the page, and how much each measures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sim.verify.box import closed_box
from sim.verify.energy import energy
from sim.verify.matter import matter
from sim.verify.phases import phases
from sim.verify.ports import ports
from sim.verify.projection import projection
from sim.verify.refraction import refraction
from sim.verify.rows import Check
from sim.verify.scattering import multiple_scattering
from sim.verify.sensor import sensor
from sim.verify.single import single_scattering

Measure = Callable[[], Check]


@dataclass(frozen=True)
class Effort:
    """How many random cases are drawn: rigs for the ports, lines of sight for the veil."""

    rigs: int
    sights: int


QUICK = Effort(rigs=10, sights=8)
FULL = Effort(rigs=60, sights=60)


def chapters(full: bool) -> dict[str, Measure]:
    """Name to measurement of every check of the quick half, or of the full evidence."""
    effort = FULL if full else QUICK
    quick: dict[str, Measure] = {
        "ports": lambda: ports(effort.rigs),
        "projection": lambda: projection(effort.rigs),
        "refraction": refraction,
        "matter": matter,
        "phases": phases,
        "single scattering": lambda: single_scattering(effort.sights),
        "energy": energy,
        "sensor": sensor,
    }
    slow: dict[str, Measure] = {
        "closed box": lambda: closed_box(1 << 19, 16),
        "multiple scattering": lambda: multiple_scattering(
            ("clear", "coastal", "harbor"), 16, 2048
        ),
    }
    return quick | slow if full else quick
