"""The grooved block seen by a camera with a tone curve that the rig states."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from lscan.config.plugins import installed
from lscan.config.targets import GroovedBlock
from lscan.errors import MeasurementError
from lscan.measure import groove_dimensions
from lscan.records import Length
from lscan.stripe import extract_stripe
from sim.render.tank import Tank
from sim.scene import load_scene
from tests.validation.exposures import (
    ScanReading,
    band_miss_percent,
    expose,
    share_inside,
    webcam_of,
)
from tests.validation.instrument.board import calibrations
from tests.validation.rows import Row, row

LINEAR = 1.0
CURVES = (LINEAR, 1.8, 2.2, 2.6)


def gamma_rows(scenes: Path, quick: bool) -> list[Row]:
    """What an undone curve changes of Table III, and whether its intervals still hold.

    Parameters
    ----------
    scenes : Path, folder of the scenes that come with lscan
    quick : bool, whether two extractors and two scans will do, and one curve
    """
    board, scene = (
        load_scene(str(scenes / "best" / f"{name}.toml")) for name in ("board", "groove")
    )
    seeds = range(1, 3 if quick else 21)
    names = ("centroid-relative", "ml") if quick else installed("lscan.extractors")
    solved = calibrations(board, seeds, board.rig.calibration.plane_map)
    tank, places = Tank(scene), scene.rig.plan.positions_mm()
    layers, block = [tank.render(place) for place in places], scene.rig.workpiece
    assert isinstance(block, GroovedBlock)
    found: dict[tuple[float, str], dict[int, list[Length]]] = {}
    for gamma in (LINEAR, 2.2) if quick else CURVES:
        curved = scene.with_tank(sensor={"gamma": gamma})
        for seed, calibration in zip(seeds, solved, strict=True):
            webcam = webcam_of(curved, seed)
            images = [
                expose(webcam, each, curved, (seed, frame)) for frame, each in enumerate(layers)
            ]
            for name in names:
                stripe = scene.rig.stripe.model_copy(update={"gamma": gamma, "extractor": name})
                stripes = [extract_stripe(image, stripe) for image in images]
                profiles = ScanReading(tuple(places), tuple(stripes)).profiles(
                    calibration.plane_map
                )
                # The brightest pixels of some scans scatter too much about the block's faces.
                with suppress(MeasurementError):
                    table = groove_dimensions(profiles, block)
                    found.setdefault((gamma, name), {})[seed] = list(table.values())
    rows = []
    for (gamma, name), scans in found.items():
        linear = found.get((LINEAR, name), {})
        both = [seed for seed in scans if seed in linear]
        lengths = [one for seed in both for one in scans[seed]]
        if not lengths:
            continue
        error, sigma = np.array([(one.error_mm, one.sigma_mm) for one in lengths]).T
        words: dict[str, Any] = {
            "seed": seeds[0],
            "extractor": name,
            "gamma": gamma,
            "lengths": len(lengths),
        }
        if gamma != LINEAR:
            plain = np.array([one.error_mm for seed in both for one in linear[seed]])
            apart = float(np.sqrt(np.mean(((error - plain) / sigma) ** 2)))
            rows.append(row("curve-undone", apart, **words))
        if name == "ml":
            share = share_inside(error, sigma)
            rows.append(
                row("curve-intervals", band_miss_percent(share), percent=100 * share, **words)
            )
    return rows
