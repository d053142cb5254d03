"""Suites: made twice to the same bytes, refused where harmed, judged in a minute."""

import io
import signal
import subprocess
import sys
import time
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lscan.benchmark.run import registered_extractors
from lscan.benchmark.suiterun import run_suite
from lscan.errors import InputError
from lscan.suites import Suite, SuiteContent, open_suite, verify_suite
from lscan.suites.content import MANIFEST, TRUTH, VERSION
from lscan.suites.files import archive_bytes
from sim.datasets.suite import load_suite_spec, make_suite
from tests.validation.rows import Row, row

# Harms to a suite's archive, each of which must be refused by name.
#
# A number's harm is the same bytes whatever the clock says: members are of 1980 (``ZipInfo``).


Harm = Callable[[Suite, bytes, np.random.Generator], bytes]


def _flipped(_: Suite, data: bytes, rng: np.random.Generator) -> bytes:
    """One bit of it is another."""
    place = int(rng.integers(len(data)))
    flipped = data[place] ^ (1 << int(rng.integers(8)))
    return data[:place] + bytes([flipped]) + data[place + 1 :]


def _cut(_: Suite, data: bytes, rng: np.random.Generator) -> bytes:
    """Its end is missing."""
    return data[: int(rng.integers(len(data)))]


def _overwritten(_: Suite, data: bytes, rng: np.random.Generator) -> bytes:
    """A piece of it is random."""
    place, size = int(rng.integers(len(data) - 64)), int(rng.integers(8, 64))
    return data[:place] + rng.bytes(size) + data[place + size :]


def _of_another_version(suite: Suite, _: bytes, rng: np.random.Generator) -> bytes:
    """Its manifest, with a right checksum, is of another version."""
    version = VERSION + int(rng.integers(1, 1000))
    return _with_content(suite, suite.content.model_copy(update={"version": version}))


def _leading_out(suite: Suite, _: bytes, rng: np.random.Generator) -> bytes:
    """A member's name leads out of the folder that it would be unpacked into."""
    outside = f"{'../' * int(rng.integers(1, 9))}etc/case-{rng.integers(1000)}"
    stated = next(iter(suite.content.members.values()))
    members = {**suite.content.members, outside: stated}
    return _with_content(suite, suite.content.model_copy(update={"members": members}))


def _twice(suite: Suite, data: bytes, rng: np.random.Generator) -> bytes:
    """Two of its members have one name."""
    stream = io.BytesIO(data)
    name = str(rng.choice(sorted(suite.content.members)))
    with zipfile.ZipFile(stream, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # zipfile's, of that very name
        archive.writestr(zipfile.ZipInfo(name), b"another")
    return stream.getvalue()


def _bomb(_suite: Suite, _: bytes, rng: np.random.Generator) -> bytes:
    """Its manifest unpacks to far more than it takes on the disk."""
    stream = io.BytesIO()
    content = bytes(int(rng.integers(2**20, 2**24)))
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(zipfile.ZipInfo(MANIFEST), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def _with_content(suite: Suite, content: SuiteContent) -> bytes:
    members = {name: suite.member(name) for name in suite.content.members}
    return archive_bytes(content, members)


HARMS: Sequence[Harm] = (
    _flipped, _cut, _overwritten, _of_another_version, _leading_out, _twice, _bomb,
)  # fmt: skip


def harmed(suite: Suite, data: bytes, number: int) -> bytes:
    """The archive harmed, in one way after the other.

    Parameters
    ----------
    suite : Suite, that is open
    data : bytes, of its archive
    number : int, of the harm, which also is the seed
    """
    return HARMS[number % len(HARMS)](suite, data, np.random.default_rng([16, number]))


# Suites: made twice to the same bytes, refused where harmed, judged in a minute.


NAME = "quick"
PART = """name = "part"

[lines]
scene = "paper/groove"
pictures = 24
turned = 5
pairs = 5

[lines.base.camera]
width_px = 160
height_px = 120
options = { auto_exposure = true, max_ms = 10000.0, percentile = 99.0 }

[lines.base.lens]
centre_px = [159.5, -92.5]

[lines.render.water.tap]
[lines.render.water.harbor.water]
kind = "harbor"
[lines.render.laser.line]
[lines.render.laser.two.stripe]
returns = "first"
[lines.render.laser.two.laser]
lines = [{ tilt_deg = -1.5, share = 0.5 }, { tilt_deg = 1.5, share = 0.5 }]

[lines.expose.noise.usual]
[lines.expose.noise.low.sensor]
dark_noise_e = 10.0
[lines.expose.fault.none]
[lines.expose.fault.gamma.sensor]
gamma = 2.2
"""
"""A suite of four renders, made several times over."""
FIRST_ORDER = "[lines.base.render]\nscatter_samples = 0\n"
KILLED_AFTER = 6  # of its cases


def made_rows(harms: int, quick: bool = False) -> list[Row]:
    """A small suite made in three ways, and its archive harmed.

    Parameters
    ----------
    harms : int, how many
    quick : bool, in the first order of light, and gone on with in this process once killed
    """
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        spec_file = folder / "part.toml"
        spec_file.write_text(PART + FIRST_ORDER * quick, encoding="utf-8")
        spec = load_suite_spec(spec_file)
        whole = make_suite(spec, folder / "whole.zip", workers="none")
        shared = make_suite(spec, folder / "shared.zip", workers=2)
        ended = folder / "ended.zip"
        kept = _kill_in_the_middle(spec_file, ended)
        make_suite(spec, ended, workers="none" if quick else 2)
        data = whole.read_bytes()
        differing = sum(other.read_bytes() != data for other in (shared, ended))
        unrefused = _unrefused(whole, harms)
    cases = sum(of.file.pictures for of in spec.case_sets)
    return [
        row("regression-same", differing, cases=cases, kept=kept),
        row("regression-harmed", unrefused, seed=16, harms=harms, cases=cases),
    ]


def _kill_in_the_middle(spec_file: Path, file: Path) -> int:
    """Kill the process that makes a suite once some cases are there; how many there were."""
    program = [sys.executable, "-m", "sim.cli.app", "suite", "make"]
    partial = file.with_name(f"{file.name}.partial")
    with subprocess.Popen(
        [*program, spec_file, "-o", file, "--workers", "1"],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as child:
        while child.poll() is None and len(list(partial.glob(f"*/{TRUTH}"))) < KILLED_AFTER:
            time.sleep(0.01)
        child.send_signal(signal.SIGKILL)
    return len(list(partial.glob(f"*/{TRUTH}")))


def _unrefused(whole: Path, harms: int) -> int:
    """How many harms to an archive are not refused by an error that names it."""
    suite, data = open_suite(whole), whole.read_bytes()
    file = whole.with_name("harmed.zip")
    unrefused = 0
    for number in range(harms):
        file.write_bytes(harmed(suite, data, number))
        try:
            verify_suite(file)
        except InputError as error:
            unrefused += str(file) not in str(error)
        else:
            unrefused += 1
    return unrefused


def judged_rows(suite: str) -> list[Row]:
    """How long judging all our extractors takes.

    Parameters
    ----------
    suite : str, its name or path
    """
    names = registered_extractors()
    begin = time.perf_counter()
    run = run_suite(suite, {"extractor": names})
    seconds = time.perf_counter() - begin
    words: dict[str, Any] = {"suite": suite, "cases": len(run.axes), "extractors": len(names)}
    return [row("regression-judged", seconds, **words)]
