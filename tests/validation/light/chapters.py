"""What holds the tank's light to its figures, in the order of the page."""

from dataclasses import dataclass, replace
from pathlib import Path

from tests.validation.light.energy import closed_box, energy
from tests.validation.light.gallery import gallery, scene_files
from tests.validation.light.higherorders import LightEffort, higher_orders
from tests.validation.light.judge import JudgeEffort
from tests.validation.light.laserleg import laser_leg
from tests.validation.light.ports import ports
from tests.validation.light.projection import projection
from tests.validation.light.refraction import refraction
from tests.validation.light.rigs import topic
from tests.validation.light.scattering import multiple_scattering
from tests.validation.light.sensor import sensor
from tests.validation.light.single import single_scattering
from tests.validation.light.water import beam_spread, matter, phases
from tests.validation.rows import Chapters, Request, Topic

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


def chapters(request: Request) -> Chapters:
    """Every check, in the order of the page.

    Parameters
    ----------
    request : Request

    Raises
    ------
    InputError
        The folder of scenes is not there.
    """
    scene_files(request.scenes)  # refuses a folder that is not there before minutes of work
    effort = QUICK if request.quick else FULL if request.full else NORMAL
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
        "scenes": lambda: scene_pictures(request.scenes, request.quick),
    }


def scene_pictures(scenes: Path, quick: bool) -> Topic:
    """One picture of each scene file, as the tank's webcam takes it with few samples a pixel."""
    pictures, rows = gallery(scenes, quick)
    return replace(topic("gallery", rows), pictures=tuple(pictures))
