"""What the geometric tier knows of pictures: how far off the instrument finds marks and line.

Found once, on pictures of the rig as it ought to be: rendered, exposed again and again, and read
by the instrument's own algorithms.  Kept beside the study, so that every worker and a study that
goes on later has the same numbers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from io import BytesIO

import numpy as np

from lscan.board import read_board
from lscan.calibration.marks import joined_marks, with_marks
from lscan.calibration.planemap import PlaneMap, SolvedMap, find_solver
from lscan.errors import MeasurementError
from lscan.files.containers import npz_arrays
from lscan.records import (
    BoardReading,
    Floats,
    Ints,
    Mask,
    Picture,
    Progress,
    Status,
    has_value,
    select,
)
from lscan.stripe.extract import extract_stripe
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene, at_moment, into_head
from sim.sensor import Webcam
from sim.studies.rig.states import ScanPlaces, places_of, require_one_line
from sim.studies.studyfile import NOISES, Study
from sim.truth import StripeTruth, board_truth, line_brightness, project, stripe_truths

LINE = 1  # of the streams of numbers drawn for one rig
EXPOSURES = 4  # of each picture: with 15 columns about a place its scatter is known to 11 %
BESIDE = 7  # columns to either side whose scatter counts with a place's own
REACH_PX = 10.0  # how far rigs are taken to be off: places within it are looked at on the board
CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
SENSOR, SPECKLE = NOISES
MOST_PREPARED_BYTES = 2**30


@dataclass(frozen=True)
class Prepared:
    """How far off marks and line are found on the rig as it ought to be.

    Attributes
    ----------
    places : ScanPlaces, P of the scan
    reading : BoardReading, M control points and marks of rulers, where they truly are, with the
        uncertainty that the instrument states
    marks_bias_px : (M, 2) array, px, found without noise less true; 0 where not found
    marks_sigma_px : (M,) array, px, of u and of v
    line_bias_px : (P,) array, px, found without noise less true, that stays in the surface
    corrected_px : (P,) array, px, the same that does not: all of it where the rig corrects for the
        sheet's thickness, which makes most of it; else none
    sensor_px, speckle_px : (P,) array, px, scatter of the line's centre by either
    """

    places: ScanPlaces
    reading: BoardReading
    marks_bias_px: Floats
    marks_sigma_px: Floats
    line_bias_px: Floats
    corrected_px: Floats
    sensor_px: Floats
    speckle_px: Floats

    def line_off_px(self, seeds: Mapping[str, int], scatter_px: Floats | None = None) -> Floats:
        """(P,) px: how far off the line is found on one rig.

        Parameters
        ----------
        seeds : mapping, of each noise that is at work
        scatter_px : (2, P) array, optional, px, by sensor and speckle in the light of that rig
        """
        off = self.line_bias_px.copy()
        if scatter_px is None:
            scatter_px = np.stack([self.sensor_px, self.speckle_px])
        for stream, name in enumerate((SENSOR, SPECKLE)):
            if name in seeds:
                rng = np.random.default_rng([seeds[name], LINE, stream])
                off += scatter_px[stream] * rng.standard_normal(len(off))
        return off

    def marks_off_px(self, seeds: Mapping[str, int], stream: int) -> Floats:
        """(M, 2) px: how far off the marks are found on one rig.

        Parameters
        ----------
        seeds : mapping, of each noise that is at work; the sensor's counts
        stream : int, another for each picture of the board
        """
        off = self.marks_bias_px.copy()
        if SENSOR in seeds:
            drawn = np.random.default_rng([seeds[SENSOR], stream]).standard_normal(off.shape)
            off += self.marks_sigma_px[:, np.newaxis] * drawn
        return off

    def packed(self) -> bytes:
        """It as the bytes of an .npz file, which holds arrays alone."""
        arrays = {f"places.{key}": value for key, value in vars(self.places).items()}
        arrays |= {key: vars(self)[key] for key in _NUMBERS}
        marks = joined_marks(self.reading)
        arrays |= {"sigma_px": marks.sigma_px, "status": marks.status}
        file = BytesIO()
        np.savez(file, **arrays)
        return file.getvalue()

    @classmethod
    def unpacked(cls, packed: bytes, study: Study) -> "Prepared":
        """What ``packed`` gave for a study.

        Parameters
        ----------
        packed : bytes
        study : Study, the same
        """
        kept = npz_arrays(packed, MOST_PREPARED_BYTES, "what a study keeps")
        places = ScanPlaces(**{f.name: kept[f"places.{f.name}"] for f in fields(ScanPlaces)})
        numbers = {name: kept[name] for name in _NUMBERS}
        reading = _reading(study.calibrate, kept["sigma_px"], kept["status"])
        return cls(places=places, reading=reading, **numbers)


_NUMBERS = (
    "marks_bias_px",
    "marks_sigma_px",
    "line_bias_px",
    "corrected_px",
    "sensor_px",
    "speckle_px",
)


def prepare(study: Study, progress: Progress | None = None) -> Prepared:
    """Render the rig as it ought to be, and see how far off its instrument finds marks and line.

    Parameters
    ----------
    study : Study
    progress : callable, optional, called with the number of pictures done, and of all

    Raises
    ------
    InputError
        The scan has several lines or a head that moves.
    MeasurementError, BoardNotFound
        The instrument does not find the line or the board.
    """
    require_one_line(study.scan)
    looked = study.file.places
    places = places_of(study.scan, looked.pictures, looked.columns)
    frames = np.unique(places.frame)
    steps = len(frames) + 1
    reading, bias, sigma = _board(study.calibrate)
    if progress:
        progress(1, steps)
    found = []
    tank = Tank(study.scan)
    for done, frame in enumerate(frames, start=2):
        found.append(_line(study.scan, tank, select(places, places.frame == frame)))
        if progress:
            progress(done, steps)
    line, sensor, speckle = (np.concatenate(parts) for parts in zip(*found, strict=True))
    known = np.isfinite(line) & np.isfinite(sensor) & np.isfinite(speckle)
    known &= on_board(study, reading, places)
    if known.sum() < np.count_nonzero(~known):
        what = f"{study.scan.source}: the line is found at {known.sum()} of {len(known)} places"
        raise MeasurementError(what)
    is_corrected = study.scan.rig.sheet is not None
    return Prepared(
        places=select(places, known),
        reading=reading,
        marks_bias_px=bias,
        marks_sigma_px=sigma,
        line_bias_px=np.zeros(known.sum()) if is_corrected else line[known],
        corrected_px=line[known] if is_corrected else np.zeros(known.sum()),
        sensor_px=sensor[known],
        speckle_px=speckle[known],
    )


def on_board(study: Study, reading: BoardReading, places: ScanPlaces) -> Mask:
    """(P,) whether the plane map has a value about each place as far as rigs may be off.

    Parameters
    ----------
    study : Study
    reading : BoardReading, of the rig as it ought to be
    places : ScanPlaces
    """
    calibration = study.calibrate.rig.calibration
    plane_map = find_solver(calibration.plane_map).solve(reading, study.calibrate.rig.optics)
    head = into_head(study.scan.tank.head, places.world_mm, places.position_mm)
    pixels = project(study.scan, head)
    about = [places_mm(plane_map, pixels + REACH_PX * np.array(way)) for way in CORNERS]
    return np.asarray(np.isfinite(np.stack(about)).all(axis=(0, 2)))


def _line(scene: Scene, tank: Tank, places: ScanPlaces) -> tuple[Floats, Floats, Floats]:
    """(P,) px each: bias, and scatter by the sensor's noise and by speckle; NaN where not found."""
    position_mm = float(places.position_mm[0])
    layers = tank.render(position_mm)
    truth = stripe_truths(scene, [position_mm])[0].centre_px
    quiet = centres_in(scene, [picture_of_layers(scene, layers, False, False, 0)])[0] - truth
    seeds = range(1, EXPOSURES + 1)
    plain = centres_in(
        scene, [picture_of_layers(scene, layers, True, False, seed) for seed in seeds]
    )
    whole = centres_in(
        scene, [picture_of_layers(scene, layers, True, True, seed) for seed in seeds]
    )
    sensor, both = (_scatter(centres, places) for centres in (plain, whole))
    return quiet[places.entry], sensor, np.sqrt(np.maximum(both**2 - sensor**2, 0.0))


def picture_of_layers(
    scene: Scene, layers: Layers, noise: bool, speckle: bool, seed: int
) -> Picture:
    """The picture of layers, with and without noise and speckle.

    Parameters
    ----------
    scene : Scene, its sensor and exposure
    layers : Layers
    noise, speckle : bool
    seed : int, of either
    """
    sensor = scene.tank.sensor
    other = {"noise": noise or speckle, "speckle": sensor.speckle if speckle else "none"}
    webcam = Webcam(scene.with_tank(sensor=other))
    webcam = webcam if noise else webcam.without_noise()
    return webcam.expose(layers, scene.rig.camera.exposure_ms, np.random.default_rng(seed))


def centres_in(scene: Scene, pictures: list[Picture]) -> Floats:
    """(K, N) px of the line in K pictures, by the rig's extractor; NaN where there is none.

    Parameters
    ----------
    scene : Scene, its rig's ``[stripe]``
    pictures : list of (H, W, 3) array, uint8, DN
    """
    stripes = [extract_stripe(picture, scene.rig.stripe) for picture in pictures]
    return np.stack([np.where(has_value(s.status), s.centre_px, np.nan) for s in stripes])


def _scatter(centres: Floats, places: ScanPlaces) -> Floats:
    """(P,) px, standard deviation of the centres about a place from picture to picture.

    NaN where fewer than half of the columns about it have a line in all pictures.
    """
    known = np.isfinite(centres).all(axis=0)
    variance = np.where(known, np.where(known, centres, 0.0).var(axis=0, ddof=1), np.nan)
    found = np.full(len(places.entry), np.nan)
    for k, entry in enumerate(places.entry):
        near = variance[max(entry - BESIDE, 0) : entry + BESIDE + 1]
        near = near[np.isfinite(near)]
        if len(near) > BESIDE:
            found[k] = np.sqrt(near.mean())
    return found


def _board(scene: Scene) -> tuple[BoardReading, Floats, Floats]:
    """The reading, and bias and scatter of its marks, px."""
    tank = Tank(scene)
    layers = tank.render(scene.rig.plan.positions_mm()[0])
    board, channel = scene.board(), scene.rig.calibration.channel
    pictures = [picture_of_layers(scene, layers, noise, noise, 1) for noise in (False, True)]
    quiet, usual = (
        joined_marks(read_board(picture, board, channel=channel)) for picture in pictures
    )
    sigma, reading = usual.sigma_px, _reading(scene, usual.sigma_px, usual.status)
    off = quiet.image_px - joined_marks(reading).image_px
    return reading, np.where(np.isfinite(off), off, 0.0), np.where(np.isfinite(sigma), sigma, 0.0)


def _reading(scene: Scene, sigma: Floats, status: Ints) -> BoardReading:
    """The marks where they truly are, with the statuses and uncertainties of a reading."""
    truth = board_truth(scene, scene.rig.plan.positions_mm()[0]).centres
    return stated_reading(truth, sigma, status)


def stated_reading(reading: BoardReading, sigma: Floats, status: Ints) -> BoardReading:
    """A reading of points and rulers alone, with other uncertainties of its marks.

    Parameters
    ----------
    reading : BoardReading
    sigma, status : (N,) array, in the order of ``joined_marks``: px, and one that is not OK takes a
        mark away
    """
    marks = joined_marks(reading)
    found = (status == Status.OK) & marks.found
    known = replace(
        marks,
        image_px=np.where(found[:, np.newaxis], marks.image_px, np.nan),
        sigma_px=np.where(found, sigma, np.nan),
        status=np.where(found, Status.OK, np.where(marks.found, status, marks.status)),
    )
    return replace(with_marks(reading, known), dots={}, rings={})


def places_mm(plane_map: PlaneMap, pixels: Floats) -> Floats:
    """(N, 2) mm of pixels, without their uncertainties where the map can do without.

    Parameters
    ----------
    plane_map : PlaneMap
    pixels : (N, 2) array, px
    """
    if isinstance(plane_map, SolvedMap):
        return plane_map.locate(pixels)
    return plane_map.to_plane(pixels).xz_mm


# How the scatter of the line's centre follows the light that a rig gives it.
#
# The scatter itself is found on pictures of the rig as it ought to be (prepared.py).  Of a rig with
# another power, exposure, water or albedo it is taken to grow as the bound of Cramér and Rao does:
# the instrument's extractor is as far above the bound as it was.
#
# The ratio is taken of all noise together, and of the sensor's alone.  An extractor that is told of
# speckle (``[stripe.noise]``) comes close to the first bound; without speckle in the picture it
# weighs the crest too little, and is a factor of two above the second.


LIGHT_KEYS = (
    "camera.exposure_ms", "laser.power_mw", "laser.waist_", "laser.wavelength_nm", "laser.fan_",
    "lens.blur_px", "lens.f_number", "lens.focus_mm", "lens.glare", "lens.vignetting", "light.",
    "sensor.", "target.albedo", "water.absorption", "water.particle_", "water.scattering",
    "water.turbidity",
)  # fmt: skip
"""What changes the line's brightness or width, or its noise, by more than its place does."""
SCATTER_REACH_PX = 12.0
STEP_PX = 0.25
"""Of the sum over a line's cross-section: it is a Gaussian integral to 1e-6 for widths of 0.4 px
and more, whose profile falls to exp(-4.5) within a third of the reach for the widest, 4 px."""


def depends_on_light(study: Study) -> bool:
    """Whether a cause changes the line's light in the scan.

    Parameters
    ----------
    study : Study
    """
    keys = {key for cause in study.file.cause.values() for key in (cause.key, *cause.together)
            if cause.when != "noise" and not key.startswith("calibrate.")}  # fmt: skip
    return any(key.removeprefix("scan.").startswith(LIGHT_KEYS) for key in keys)


def lines_at(scan: Scene, places: ScanPlaces) -> list[StripeTruth]:
    """The true line in each picture that has places, other columns left out.

    Parameters
    ----------
    scan : Scene, as it ought to be
    places : ScanPlaces
    """
    found = []
    for frame in np.unique(places.frame):
        here = places.frame == frame
        truth = stripe_truths(scan, [float(places.position_mm[here][0])])[0]
        status = np.full_like(truth.status, Status.NO_PEAK)
        status[places.entry[here]] = truth.status[places.entry[here]]
        found.append(replace(truth, status=status))
    return found


def line_bounds_px(scan: Scene, places: ScanPlaces, lines: Sequence[StripeTruth]) -> Floats:
    """(2, P) px, least scatter of the line's centre: by the sensor's noise, and speckle with it.

    The line is taken to lie where it ought to: what moves it by pixels changes its light little.

    Parameters
    ----------
    scan : Scene, in any state; its changes are those of each picture
    places : ScanPlaces
    lines : sequence of StripeTruth, as ``lines_at`` gives them

    References
    ----------
    Kay, Fundamentals of Statistical Signal Processing I, sec. 3.9: of a symmetric profile the
    centre's part of Fisher's information is independent of width, height and ground.
    """
    found = np.full((2, len(places.frame)), np.nan)
    for frame, line in zip(np.unique(places.frame), lines, strict=True):
        here = places.frame == frame
        moment = at_moment(scan, int(frame), line.position_mm)
        found[:, here] = _of_picture(moment.scene, line, places.entry[here])
    return found


def _of_picture(scene: Scene, line: StripeTruth, column: Ints) -> Floats:
    """(2, N) px at N columns of the picture."""
    speckled = line_brightness(scene, [line])[0]
    plain = line_brightness(scene.with_tank(sensor={"speckle": "none"}), [line])[0]
    height, ground = plain.height_dn[column], plain.noise_dn[column] ** 2
    crest = plain.height_sigma_dn[column] ** 2
    shot = (crest - ground) / height
    grain = speckled.height_sigma_dn[column] ** 2 - crest
    speckle2 = np.maximum(grain, 0.0) / height**2
    both = (
        centre_variance_px2(plain.width_px[column], height, ground, shot, grain2)
        for grain2 in (0.0 * speckle2, speckle2)
    )
    return np.sqrt(np.stack(list(both)))


def centre_variance_px2(
    width_px: Floats, height_dn: Floats, ground_dn2: Floats, shot_dn: Floats, speckle2: Floats
) -> Floats:
    """(N,) px², the bound of a Gaussian line's centre, pixels taken for points.

    Parameters
    ----------
    width_px : (N,) array, px, standard deviation of the line
    height_dn : (N,) array, DN, of its crest
    ground_dn2 : (N,) array, DN², variance of a pixel beside it
    shot_dn : (N,) array, DN, further variance for each DN of light
    speckle2 : (N,) array, further variance for each DN² of light
    """
    away = np.arange(-SCATTER_REACH_PX, SCATTER_REACH_PX + STEP_PX, STEP_PX)
    light = height_dn[:, None] * np.exp(-((away / width_px[:, None]) ** 2) / 2)
    variance = ground_dn2[:, None] + shot_dn[:, None] * light + speckle2[:, None] * light**2
    slope = light * away / width_px[:, None] ** 2
    information: Floats = STEP_PX * (slope**2 / variance).sum(axis=1)
    return 1 / information
