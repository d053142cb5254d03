"""Rigs drawn at random: what ``lscan-sim check`` says of them, against pictures of them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from lscan.files.pictures import linear_picture
from lscan.records import Status
from lscan.stripe import extract_stripe
from lscan.stripe.peaks import crests, line_width
from lscan.stripe.picture import CLIPPED_DN, lines_of
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from sim.sensor import Webcam
from sim.studies.rigcheck import check_rig
from tests.validation.exposures import expose, webcam_of
from tests.validation.rows import Row, row

RIGS, PICTURES = 20, 12
WATERS = ("clear", "tank-1ntu", "coastal")
FEWEST = 50  # columns that are not clipped, for a scatter that is known to 5 %


def check_rows(
    scenes: Path, rigs: int = RIGS, pictures: int = PICTURES, seed: int = 1
) -> list[Row]:
    """The greatest of how far brightness, clipped share, width and scatter are from what is said.

    Parameters
    ----------
    scenes : Path, folder of the scenes that the rigs are made from
    rigs : int, how many are drawn
    pictures : int, of each rig, whose lines scatter
    seed : int, of the rigs and the pictures
    """
    drawn = drawn_rigs(scenes, np.random.default_rng(seed), rigs)
    off = np.abs([_off_percent(scene, pictures) for scene in drawn])
    words: dict[str, Any] = {"rigs": rigs, "seed": seed}
    return [
        row(
            f"check-{name}",
            float(np.nanmax(each)),
            median=float(np.nanmedian(each)),
            known=int(np.isfinite(each).sum()),
            **words,
        )
        for name, each in zip(("peak", "clipped", "width", "scatter"), off.T, strict=True)
    ]


def drawn_rigs(scenes: Path, rng: np.random.Generator, count: int) -> Iterator[Scene]:
    """Rigs that look at the grooved block or the sandwave: optics, light, water, sensor and bits.

    Parameters
    ----------
    scenes : Path, their folder
    rng : Generator
    count : int, of rigs
    """
    for number in range(count):
        scene = load_scene(scenes / "best" / f"{('groove', 'sandwave')[number % 2]}.toml")
        f_number, blur_px, power_mw, waist_mm = (
            float(rng.uniform(*ends)) for ends in ((1.8, 8.0), (0.4, 1.5), (3.0, 30.0), (0.3, 1.0))
        )
        scene = scene.with_tank(
            water=vars(load_scene(scenes / "waters" / f"{rng.choice(WATERS)}.toml").tank.water),
            lens={"f_number": f_number, "blur_px": blur_px},
            laser={"power_mw": power_mw, "waist_mm": waist_mm},
            sensor={
                "gamma": float(rng.choice([1.0, 2.2])),
                "dark_noise_e": float(rng.uniform(5.0, 60.0)),
                "full_well_e": float(rng.uniform(8e3, 3e4)),
                "speckle": str(rng.choice(["none", "depolarised"])),
            },
            target={"albedo": float(rng.uniform(0.1, 0.8))},
            render={"fineness": 1, "samples": 4, "scatter_samples": 0},
        )
        camera = {"exposure_ms": float(rng.uniform(5.0, 40.0)), "bits": int(rng.choice([8, 12]))}
        stripe = {"gamma": scene.tank.sensor.gamma, "noise": None, "threshold_dn": 6.0}
        update = {
            name: getattr(scene.rig, name).model_copy(update=keys)
            for name, keys in (("camera", camera), ("stripe", stripe))
        }
        yield replace(scene, rig=scene.rig.model_copy(update=update))


def _off_percent(scene: Scene, pictures: int) -> tuple[float, float, float, float]:
    """By how much what is said is off, %: of the peak; of the line's columns, clipped ones; of the
    width; of the scatter.  NaN of the latter two where too little of the line is not clipped.
    """
    found = check_rig(scene)
    positions = scene.rig.plan.positions_mm()
    layers = Tank(scene).render(positions[len(positions) // 2])
    quiet = Webcam(scene.with_tank(sensor={"noise": False, "speckle": "none"}))
    picture = quiet.expose(layers, scene.rig.camera.exposure_ms, np.random.default_rng(0))
    grey = lines_of(picture, "red", "columns").grey
    peak_dn = grey.max(axis=1)[found.entry]
    # Beyond what the picture rounds.
    off_dn = np.maximum(np.abs(found.grey_dn[0] - peak_dn) - scene.rig.camera.step_dn / 2, 0)
    peak = 100 * float(np.quantile(off_dn / peak_dn, 0.9))
    clipped = 100 * float(np.mean(found.clipped) - np.mean(peak_dn >= CLIPPED_DN))
    whole = ~found.clipped & (np.subtract(*found.grey_dn) > scene.rig.stripe.threshold_dn)
    if whole.sum() < FEWEST:
        return peak, clipped, np.nan, np.nan
    at = found.entry[whole]
    light = lines_of(linear_picture(picture, scene.rig.stripe.gamma), "red", "columns").grey
    width_px = line_width(light, at, crests(light)[at])
    width = 100 * (float(np.median(found.light.width_px[whole])) / width_px - 1)
    centres = []
    for seed in range(pictures):
        taken = expose(webcam_of(scene, seed), layers, scene, (seed, 0))
        stripe = extract_stripe(taken, scene.rig.stripe)
        centres.append(np.where(stripe.status == Status.OK, stripe.centre_px, np.nan)[at])
    variance = np.var(centres, axis=0, ddof=1)  # NaN where one of them has no centre
    known = np.isfinite(variance)
    if known.sum() < FEWEST:
        return peak, clipped, width, np.nan
    said = (found.sigma_z_mm[1] / found.mm_per_px[:, 1])[whole][known]
    ratio = np.sqrt(
        np.median(variance[known] / said**2) / float(chi2.median(pictures - 1) / (pictures - 1))
    )
    return peak, clipped, width, 100 * (1 / float(ratio) - 1)
