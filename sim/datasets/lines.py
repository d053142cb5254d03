"""Pictures of a laser line for a suite, with the truth of every column."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lscan.records import Bytes, Floats, Mask, Status
from lscan.suites import CaseTruth, LightLayers, SuiteCase
from sim.datasets.labels import label_scene, one_step_w_m2_sr
from sim.scene import Scene
from sim.truth import StripeTruth, line_brightness, stripe_truth

if TYPE_CHECKING:
    from sim.render.layers import Layers


def line_truths(scene: Scene) -> list[StripeTruth]:
    """The truth of each of the laser's lines at the start of the plan; of one where it is off.

    Parameters
    ----------
    scene : Scene
    """
    laser = scene.tank.laser
    lines = range(len(laser.sheets) if laser.on else 1)
    return [stripe_truth(scene, scene.rig.plan.start_mm, line) for line in lines]


def line_case(
    scene: Scene,
    name: str,
    axes: Mapping[str, str],
    layers: "Layers",
    truths: Sequence[StripeTruth],
    *,
    pair: bool = False,
) -> SuiteCase:
    """The light of one render as the scene's webcam takes it, with its truth.

    Parameters
    ----------
    scene : Scene
    name : str, of the case
    axes : mapping, its values
    layers : Layers, rendered at the start of the plan
    truths : sequence, as of ``line_truths``
    pair : bool, whether there is a picture with the laser off besides
    """
    from sim.devices import exposure_of
    from sim.sensor import Webcam

    webcam = Webcam(scene)
    exposure_ms = exposure_of(scene, webcam, layers)
    seed, position_mm = scene.tank.sensor.seed, scene.rig.plan.start_mm
    shown = truths if scene.tank.laser.on else ()
    dark = None
    if pair:
        none = np.zeros_like(layers.ambient)
        unlit = replace(layers, direct=none, scattered=none)
        dark = webcam.expose(unlit, exposure_ms, np.random.default_rng([seed, 2]))
    return SuiteCase(
        name,
        axes,
        webcam.expose(layers, exposure_ms, np.random.default_rng([seed, 1])),
        dark,
        label_scene(scene, position_mm, layers, shown, exposure_ms),
        _truth_of(scene, truths, exposure_ms),
        scene.rig.stripe,
        _layers_in_dn(scene, layers, exposure_ms),
    )


def _layers_in_dn(scene: Scene, layers: "Layers", exposure_ms: float) -> LightLayers | None:
    """None where no light reaches the sensor's electrons."""
    step = one_step_w_m2_sr(scene, exposure_ms)
    if not np.isfinite(step):
        return None
    camera = scene.rig.camera
    pixels = layers.binned((camera.height_px, camera.width_px))
    return LightLayers(
        *(layer.astype(float) / step for layer in (pixels.direct, pixels.scattered, pixels.ambient))
    )


def _truth_of(scene: Scene, truths: Sequence[StripeTruth], exposure_ms: float) -> CaseTruth:
    """The line that [stripe] means, column by column: the first or last of several lines."""
    lights = line_brightness(scene, truths, [exposure_ms] * len(truths))
    centres = np.stack([one.centre_px for one in truths])
    shown: Mask = np.stack([one.status == Status.OK for one in truths])
    last = scene.rig.stripe.returns == "last"
    key: Floats = np.where(shown, -centres if last else centres, np.inf)
    meant, along = key.argmin(axis=0), np.arange(centres.shape[1])
    some = shown.any(axis=0)
    status = np.where(some, int(Status.OK), truths[0].status)
    several = (shown.sum(axis=0) > 1) & (scene.rig.stripe.returns == "brightest")
    hidden = np.stack([one.multiple for one in truths]).any(axis=0)  # the truth has one of them

    def of(values: Sequence[Floats]) -> Floats:
        chosen: Floats = np.stack(values)[meant, along]
        return np.where(some, chosen, np.nan)

    return CaseTruth(
        of([one.centre_px for one in truths]),
        of([one.width_px for one in lights]),
        of([one.height_dn for one in lights]),
        of([one.noise_dn for one in lights]),
        (several | hidden).astype(np.int64),
        status.astype(np.int64),
    )


def turned_case(case: SuiteCase) -> SuiteCase:
    """The case as a camera sees it whose columns are the other's rows.

    Parameters
    ----------
    case : SuiteCase, of a line across the columns
    """

    def swapped(image: Bytes) -> Bytes:
        return np.ascontiguousarray(np.swapaxes(image, 0, 1))

    return replace(
        case,
        picture=swapped(case.picture),
        dark=None if case.dark is None else swapped(case.dark),
        labels=swapped(case.labels),
        layers=None if case.layers is None else case.layers.turned(),
        settings=case.settings.model_copy(update={"axis": "rows"}),
    )
