"""The chapters of the evidence, in the order of the page, and how much each measures."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from sim.render.judge.judged import JudgeEffort
from sim.validation.physics.box import closed_box
from sim.validation.physics.energy import energy
from sim.validation.physics.higherorders import LightEffort, higher_orders
from sim.validation.physics.laserleg import laser_leg
from sim.validation.physics.matter import matter
from sim.validation.physics.phases import phases
from sim.validation.physics.ports import ports
from sim.validation.physics.projection import projection
from sim.validation.physics.refraction import refraction
from sim.validation.physics.scattering import multiple_scattering
from sim.validation.physics.sensor import sensor
from sim.validation.physics.single import single_scattering
from sim.validation.physics.spreading import beam_spread
from sim.validation.rows import Topic

Measure = Callable[[], Topic]
LIGHT = LightEffort()


@dataclass(frozen=True)
class VerifyEffort:
    """How much is measured; by default all of it.

    rigs: random ones for the ports.  sights: random lines of sight for the veil.  leg_samples: a
    place of the floor under a sheet.  photons: for tables of how a beam spreads.  box_rays,
    box_batches: of the closed box.  runs, samples: independent pictures a side against volpath,
    and its samples a pixel.  light: of higher orders against the judge.
    """

    rigs: int = 60
    sights: int = 60
    leg_samples: int = 1 << 22
    photons: int = 1 << 22
    box_rays: int = 1 << 19
    box_batches: int = 16
    runs: int = 16
    samples: int = 2048
    light: LightEffort = LIGHT


NORMAL = VerifyEffort()
# Twelve random rigs, and so many walks that the judge's standard error is about 0.5 %: an hour.
FULL = replace(NORMAL, light=LightEffort(rigs=3, judge=JudgeEffort(batches=32)))
QUICK = VerifyEffort(
    rigs=2,
    sights=2,
    leg_samples=1 << 14,
    photons=1 << 16,
    box_rays=1 << 14,
    box_batches=4,
    runs=2,  # the fewest that have a variance
    samples=16,
    light=LightEffort(
        targets=1, depths=1, columns=16, judge=JudgeEffort(photons=1 << 16, walks=4, batches=2)
    ),
)
WATERS = ("clear", "coastal", "harbor")


def chapters(effort: VerifyEffort) -> dict[str, Measure]:
    """Name to measurement of every check, in the order of the page."""
    return {
        "ports": lambda: ports(effort.rigs),
        "projection": lambda: projection(effort.rigs),
        "refraction": refraction,
        "matter": matter,
        "phases": phases,
        "single scattering": lambda: single_scattering(effort.sights),
        "laser leg": lambda: laser_leg(effort.leg_samples),
        "spread of a beam": lambda: beam_spread(effort.photons),
        "energy": energy,
        "sensor": sensor,
        "closed box": lambda: closed_box(effort.box_rays, effort.box_batches),
        "all orders of scattering": lambda: multiple_scattering(
            WATERS, effort.runs, effort.samples
        ),
        "light of higher orders": lambda: higher_orders(effort.light),
    }
