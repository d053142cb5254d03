"""Whole chains judged on a suite's scans: from the board's picture to points, grooves and slices.

Each coordinate counts as a column of a line does, as with boards: the sums are those of extractors,
and so are the table and the comparison of two runs.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lscan.benchmark.boardjudging import coordinate_sums, map_sums
from lscan.benchmark.judging import CaseSums, JudgedExtractor, beside_line, reference_seconds
from lscan.board import read_board
from lscan.calibration.calibrate import calibrate
from lscan.calibration.check import carried
from lscan.calibration.planemap import PlaneMap
from lscan.config.documents import Document, check, merge, read_document
from lscan.config.rig import Rig
from lscan.config.scenes import included_file
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError, LscanError
from lscan.measure import groove_dimensions
from lscan.pipeline import build_surface, correct, finish
from lscan.records import Mask, Profile, Status
from lscan.stripe.extract import extract_stripes
from lscan.suites import ScanCase
from lscan.surface.surface import Slice, sample, to_profiles

CHAINS = ("paper/rig", "best/groove")
"""That take part unless told otherwise: the paper's, and the best."""
SECTIONS = ("stripe", "calibration", "sheet")
"""What a chain is of a rig file; all else is the rig itself."""
BOARD, POINTS, GROOVES, SLICES = PARTS = ("board", "points", "grooves", "slices")
CLEAR = 1.5  # times the threshold: a line that must be found, whatever the noise
WRONG_MM = 1.0  # off, and a height or a length is wrong: what is to be measured to a millimetre


def load_chain(path: str) -> Document:
    """The sections of a rig file that say how pictures are worked on.

    Parameters
    ----------
    path : str, of a TOML file, or the name of a scene; a file of the three sections alone will do

    Raises
    ------
    InputError
        There is no such file, or it has none of them.
    """
    document = read_document(included_file(Path(), path))
    chain = {name: document[name] for name in SECTIONS if name in document}
    if not chain:
        allowed = ", ".join(f"[{name}]" for name in SECTIONS)
        raise InputError("has no section of a chain", where=path, allowed=allowed)
    return chain


def judge_chains(
    chains: Sequence[str], cases: Iterable[ScanCase], step: Callable[[], None] = lambda: None
) -> tuple[list[JudgedExtractor], float]:
    """Each chain on each scan.

    Parameters
    ----------
    chains : sequence of str, as of ``load_chain``
    cases : iterable
    step : callable, called after each case

    Returns
    -------
    Of each chain one record for each of PARTS that the suite's scans have, named "CHAIN: PART", and
    the median seconds of the reference workload.

    Raises
    ------
    InputError
        A chain is none, or names what is not there.
    """
    loaded = {name: load_chain(name) for name in chains}
    sums: dict[tuple[str, str], dict[str, CaseSums]] = {
        (name, part): {} for name in chains for part in PARTS
    }
    reference = []
    for case in cases:
        reference.append(reference_seconds())
        for name, chain in loaded.items():
            for part, of in judge_chain(name, chain, case).items():
                sums[name, part][case.name] = of
        step()
    judged = [
        JudgedExtractor(f"{name}: {part}", of, (), f"--chain {name}")
        for (name, part), of in sums.items()
        if of
    ]
    return judged, float(np.median(reference or [np.nan]))


def judge_chain(name: str, chain: Document, case: ScanCase) -> dict[str, CaseSums]:
    """The sums of one scan, mm, by part; nothing of a part is found where the chain refuses.

    Parameters
    ----------
    name : str, of the chain, for errors
    chain : mapping, sections that are laid over those of the case's rig
    case : ScanCase

    Raises
    ------
    InputError
        A key of the chain is wrong.
    """
    rig = check(Rig, merge(case.rig.model_dump(exclude_unset=True), chain), where=name)
    plane_map, board_s = _tried(_calibrated, case, rig)
    profiles, line_s = _tried(_profiles, case, rig, plane_map)
    sums = {
        BOARD: map_sums(plane_map, case.board, board_s),
        POINTS: _point_sums(profiles, rig, case, line_s),
    }
    if isinstance(rig.workpiece, GroovedBlock):
        sums[GROOVES] = _groove_sums(profiles, rig.workpiece)
    if isinstance(rig.workpiece, Sandwave):
        sums[SLICES] = _slice_sums(profiles, rig, case)
    return sums


def _tried(stage: Callable[..., Any], *given: Any) -> tuple[Any, float]:
    """What a stage returns, None where it refuses or has nothing to work on, and its seconds."""
    if any(one is None for one in given):
        return None, 0.0
    began = time.process_time()
    try:
        found = stage(*given)
    except InputError:
        raise  # of what the chain says, not of the pictures
    except LscanError:
        found = None
    return found, time.process_time() - began


def _calibrated(case: ScanCase, rig: Rig) -> PlaneMap:
    reading = read_board(case.board.picture, case.board.board, channel=rig.calibration.channel)
    return carried(calibrate(reading, rig.calibration.plane_map, rig.optics).plane_map, rig)


def _profiles(case: ScanCase, rig: Rig, plane_map: PlaneMap) -> list[Profile]:
    stripes = extract_stripes([(frame, None) for frame in case.frames], rig.stripe)
    return to_profiles(stripes, plane_map, list(rig.plan.positions_mm()))


def _point_sums(
    profiles: list[Profile] | None, rig: Rig, case: ScanCase, seconds: float
) -> CaseSums:
    """(x, z) of every column with a clear line, corrected for what the chain corrects for."""
    line = case.status == Status.OK
    clear = line & (case.multiple == 0) & (case.height_dn > CLEAR * rig.stripe.threshold_dn)
    clear &= _on_board(case)
    dark: Mask = ~np.stack([beside_line(of) for of in line])
    places = np.full_like(case.line_mm, np.nan)
    sigma = np.full_like(case.line_mm, np.nan)
    if profiles is not None:
        surface = correct(build_surface(profiles, rig), rig)
        places = surface.xyz_mm[..., ::2]
        sigma = np.stack([surface.sigma_x_mm, surface.sigma_z_mm], axis=-1)
    valued = np.isfinite(places[..., 0] + places[..., 1])
    kept = clear | dark
    error = places - case.line_mm
    return coordinate_sums(clear[kept], valued[kept], error[kept], sigma[kept], WRONG_MM, seconds)


def _on_board(case: ScanCase) -> Mask:
    """(F, N) the points within the board, beyond which no map is known to hold."""
    low, high = case.board.map_mm.min(axis=0), case.board.map_mm.max(axis=0)
    with np.errstate(invalid="ignore"):
        inside: Mask = ((case.line_mm >= low) & (case.line_mm <= high)).all(axis=-1)
    return inside


def _groove_sums(profiles: list[Profile] | None, piece: GroovedBlock) -> CaseSums:
    """The block's dimensions."""
    lengths, seconds = _tried(groove_dimensions, profiles, piece)
    count = len(piece.dimensions_mm())
    error, sigma = np.full((count, 1), np.nan), np.full((count, 1), np.nan)
    if lengths is not None:
        error[:, 0] = [length.error_mm for length in lengths.values()]
        sigma[:, 0] = [length.sigma_mm for length in lengths.values()]
    valued = np.isfinite(error[:, 0])
    return coordinate_sums(np.ones(count, bool), valued, error, sigma, WRONG_MM, seconds)


def _slice_sums(profiles: list[Profile] | None, rig: Rig, case: ScanCase) -> CaseSums:
    """Heights along the slices, where the sandwave is lit and seen, its border left out."""
    piece, (x, y, z) = rig.workpiece, case.slices_mm.T
    assert isinstance(piece, Sandwave)
    seen = case.slice_status == Status.OK
    error, sigma = np.full((len(z), 1), np.nan), np.full((len(z), 1), np.nan)
    cut, seconds = _tried(_slices, profiles, rig, case)
    if cut is not None:
        seen &= piece.inset_mm(x, y) >= cut.radius_mm  # beyond it, heights of the rim are in them
        error[:, 0], sigma[:, 0] = cut.z_mm - z, cut.sigma_z_mm
    kept = seen | (case.slice_status != Status.OK)
    valued = np.isfinite(error[:, 0])
    return coordinate_sums(seen[kept], valued[kept], error[kept], sigma[kept], WRONG_MM, seconds)


def _slices(profiles: list[Profile], rig: Rig, case: ScanCase) -> Slice:
    built = finish(build_surface(profiles, rig), rig)
    built.require_alignment()
    return sample(built.surface, case.slices_mm[:, :2])
