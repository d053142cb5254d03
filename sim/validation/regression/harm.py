"""Harms to a suite's archive, each of which must be refused by name.

A number's harm is the same bytes whatever the clock says: members are of 1980 (``ZipInfo``).
"""

import io
import warnings
import zipfile
from collections.abc import Callable, Sequence

import numpy as np

from lscan.suites import Suite, SuiteContent
from lscan.suites.content import MANIFEST, VERSION
from lscan.suites.files import archive_bytes

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
