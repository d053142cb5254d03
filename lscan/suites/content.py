"""What a suite holds: its manifest, and a case's picture and truth as bytes of its members."""

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from lscan.config.documents import Model, Strict, check
from lscan.config.plugins import refuse_code
from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.files.disk import parse_json
from lscan.files.pictures import encoded
from lscan.records import Bytes, Floats, Ints, Status
from lscan.suites.layers import LightLayers, layers_picture

MANIFEST = "suite.json"
VERSION = 3
MOST_MANIFEST_BYTES, MOST_MEMBER_BYTES, MOST_SUITE_BYTES = 2**25, 2**28, 2**31
PICTURE, DARK, LABELS, TRUTH, SETTINGS = (
    "picture.png", "dark.png", "labels.png", "truth.csv", "stripe.json",
)  # fmt: skip
PARTS = (PICTURE, LABELS, TRUTH, SETTINGS)
LAYERS = "layers.png"  # of a line's picture, where they are known
MAP, BOARD, OPTICS = "map.csv", "board.json", "optics.json"
BOARD_PARTS = (PICTURE, TRUTH, MAP, BOARD, OPTICS)
FRAME, RIG, LINE, SLICES = "frame-{:04d}.png", "rig.json", "line.csv", "slices.csv"
SCAN_PARTS = (*BOARD_PARTS, RIG, LINE)
COLUMNS = ("centre_px", "sigma_px", "height_dn", "noise_dn", "multiple", "status")
SMOOTH = (cv2.IMWRITE_PNG_COMPRESSION, 9)  # of a PNG without noise
_PLAIN = re.compile(r"[a-z0-9][a-z0-9._-]*/[a-z0-9][a-z0-9._-]*")
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+-]{0,99}$")]


class MemberSum(Strict):
    """Size in bytes and checksum of a member."""

    size: int = Field(ge=0, le=MOST_MEMBER_BYTES)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class SuiteContent(Strict):
    """The manifest.

    cases: pictures of a laser line, by name, with the case's value on each axis (water, target
    ...).  boards, scans: likewise, pictures of the calibration board, and whole scans.
    """

    format: Literal["lscan-suite"] = "lscan-suite"
    version: int = VERSION
    name: str = Field(pattern="^[a-z0-9][a-z0-9-]{0,63}$")
    seed: int = Field(ge=0)
    made_by: Word
    cases: Mapping[str, Mapping[Word, Word]]
    boards: Mapping[str, Mapping[Word, Word]] = Field(default_factory=dict)
    scans: Mapping[str, Mapping[Word, Word]] = Field(default_factory=dict)
    members: Mapping[str, MemberSum]

    @property
    def kinds(self) -> dict[str, Mapping[str, Mapping[str, str]]]:
        """What it holds, by what it is called, each by name with its axes."""
        return {"cases": self.cases, "boards": self.boards, "scans": self.scans}


@dataclass(frozen=True)
class CaseTruth:
    """The truth of a line in a picture, by column (or row, where the line runs down).

    Attributes
    ----------
    centre_px : (N,) array, px; NaN where the line is not to be seen
    sigma_px : (N,) array, px, standard deviation of the line across
    height_dn : (N,) array, DN, its peak above what lies about it
    noise_dn : (N,) array, DN, standard deviation of the noise beside it
    multiple : (N,) array, 1 where the column holds several lines and none of them is the one meant
    status : (N,) array, of Status
    """

    centre_px: Floats
    sigma_px: Floats
    height_dn: Floats
    noise_dn: Floats
    multiple: Ints
    status: Ints


@dataclass(frozen=True)
class SuiteCase:
    """One picture of a suite.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the suite's axes
    picture : (H, W) or (H, W, 3) array, uint8, DN
    dark : as ``picture``, with the laser off; None where there is none
    labels : (H, W) array, uint8, class of each pixel (sim.datasets.labels.Label)
    truth : CaseTruth
    settings : StripeSection, of the rig: noise, threshold, axis
    layers : LightLayers or None, of each pixel, where they are known
    """

    name: str
    axes: Mapping[str, str]
    picture: Bytes
    dark: Bytes | None
    labels: Bytes
    truth: CaseTruth
    settings: StripeSection
    layers: LightLayers | None = None


def axes_of(cases: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, int]]:
    """How many cases there are of each value on each axis.

    Parameters
    ----------
    cases : mapping, of a manifest: ``cases``, ``boards`` or ``scans``
    """
    found: dict[str, Counter[str]] = {}
    for axes in cases.values():
        for axis, value in axes.items():
            found.setdefault(axis, Counter())[value] += 1
    return {axis: dict(sorted(counts.items())) for axis, counts in found.items()}


def manifest_bytes(content: SuiteContent) -> bytes:
    """The one file that says this content: JSON with sorted keys, and its own checksum before."""
    plain = json.dumps(content.model_dump(mode="json"), sort_keys=True, indent=1)
    return f"{hashlib.sha256(plain.encode()).hexdigest()}\n{plain}\n".encode()


def read_manifest(data: bytes, where: object) -> SuiteContent:
    """The content that ``manifest_bytes`` wrote; InputError for any other bytes."""
    try:
        stated, _, plain = data.decode().partition("\n")
        if hashlib.sha256(plain[:-1].encode()).hexdigest() != stated or plain[-1:] != "\n":
            raise InputError(f"{MANIFEST} does not have its own checksum", where=where)
        document = parse_json(plain, where)
        version = document.get("version") if isinstance(document, dict) else None
        if version != VERSION:
            allowed = f"{VERSION}; lscan-sim suite make renders it anew"
            raise InputError(
                f"{MANIFEST} is of another version", where=where, value=version, allowed=allowed
            )
    except UnicodeDecodeError as error:
        raise InputError(f"{MANIFEST} is no manifest of a suite", where=where) from error
    content = check(SuiteContent, document, where=where, prefix=MANIFEST)
    for name in content.members:
        if not _PLAIN.fullmatch(name):
            raise InputError("a member has a name that is not plain", where=where, value=name)
    kinds = content.kinds.values()
    for cases, parts in zip(kinds, (PARTS, BOARD_PARTS, SCAN_PARTS), strict=True):
        for name in (f"{case}/{part}" for case in cases for part in parts):
            if name not in content.members:
                raise InputError(f"member {name} is not in the manifest", where=where)
    named = Counter(name for cases in kinds for name in cases)
    if twice := [name for name, count in named.items() if count > 1]:
        raise InputError("a case is of two kinds", where=where, value=min(twice))
    if sum(member.size for member in content.members.values()) > MOST_SUITE_BYTES:
        raise InputError(f"{MANIFEST} states more than a suite may hold", where=where)
    return content


def truth_bytes(truth: CaseTruth) -> bytes:
    """The truth as CSV: centres to 1e-5 px, all else to four digits."""
    stream = io.StringIO()
    stream.write(",".join(COLUMNS) + "\n")
    table = np.column_stack([getattr(truth, name) for name in COLUMNS])
    np.savetxt(stream, table, fmt=("%.5f", "%.4g", "%.4g", "%.4g", "%d", "%d"), delimiter=",")
    return stream.getvalue().encode()


def read_truth(data: bytes, where: object) -> CaseTruth:
    """The truth that ``truth_bytes`` wrote; InputError where it is none."""
    try:
        rows = list(csv.reader(io.StringIO(data.decode())))
        if tuple(rows[0]) != COLUMNS:
            raise ValueError
        table = np.array(rows[1:], dtype=float).reshape(len(rows) - 1, len(COLUMNS))
        multiple, status = table[:, 4], table[:, 5]
        if not (np.isin(multiple, (0, 1)).all() and np.isin(status, list(Status)).all()):
            raise ValueError
        if not np.isfinite(table[status == Status.OK, :2]).all():
            raise ValueError
    except (ValueError, IndexError, csv.Error) as error:
        raise InputError("is no table of a line's truth", where=where) from error
    centre, sigma, height, noise = table[:, :4].T
    whole = multiple.astype(np.int64), status.astype(np.int64)
    return CaseTruth(centre, sigma, height, noise, *whole)


def read_section(model: type[Model], data: bytes, where: object) -> Model:
    """The section of a rig file in a member; InputError where it is none, or names code."""
    section = check(model, parse_json(data, where), where=where)
    for of in (section, getattr(section, "stripe", None)):
        if isinstance(of, StripeSection):
            refuse_code(of.extractor, where)
    return section


def member_sum(data: bytes) -> MemberSum:
    """Size and checksum of a member's bytes."""
    return MemberSum(size=len(data), sha256=hashlib.sha256(data).hexdigest())


def noisy_png(picture: Bytes) -> bytes:
    """The PNG of a picture with noise: a fifteenth smaller than by the usual compression."""
    level = (cv2.IMWRITE_PNG_COMPRESSION, 3)  # stated at all, each line has its own filter
    return encoded(
        picture, ".png", (*level, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    )


def case_members(case: SuiteCase) -> dict[str, bytes]:
    """The bytes of each member of a case by its name, that of the truth last."""
    noisy = {PICTURE: case.picture, DARK: case.dark}
    members = {name: noisy_png(shown) for name, shown in noisy.items() if shown is not None}
    members[LABELS] = encoded(case.labels, ".png")
    if case.layers is not None:
        members[LAYERS] = encoded(layers_picture(case.layers), ".png", SMOOTH)
    members[SETTINGS] = f"{case.settings.model_dump_json(indent=1)}\n".encode()
    members[TRUTH] = truth_bytes(case.truth)
    return {f"{case.name}/{name}": data for name, data in members.items()}
