"""Suites published as a package: a wheel of data alone, which lscan finds by its entry point."""

import base64
import hashlib
import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from lscan.errors import InputError
from lscan.files.disk import make_folder, read_bytes, write_atomically
from lscan.suites.content import MOST_SUITE_BYTES
from lscan.suites.find import GROUP
from lscan.suites.reader import verify_suite
from lscan.version import __version__

_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?")
_VERSION = re.compile(r"\d+(\.\d+)*((a|b|rc)\d+)?(\.post\d+)?(\.dev\d+)?", re.ASCII)
LONGEST = 100  # characters of a name or version


def write_suite_wheel(archives: Sequence[Path], folder: Path, name: str, version: str) -> Path:
    """Write the wheel of some suites: the same bytes of the same suites, whenever and wherever.

    Parameters
    ----------
    archives : sequence of Path, of suites, each checked to the last byte; found by their own names
    folder : Path, for the wheel; made where it is missing
    name : str, of the distribution
    version : str, of it

    Returns
    -------
    The wheel's path.

    Raises
    ------
    InputError
        A suite is harmed or no archive, two have one name, name or version are none, or the name is
        of a package that is installed and has no suites, whose files the wheel would replace.

    References
    ----------
    Binary distribution format of the Python Packaging Authority (PEP 427), names and versions of
    PEP 503 and PEP 440.
    """
    for what, value, pattern in (("name", name, _NAME), ("version", version, _VERSION)):
        if len(value) > LONGEST or not pattern.fullmatch(value):
            allowed = "such as lscan-suites" if what == "name" else "such as 1.0"
            raise InputError(f"is no {what} of a package", where=f"--{what}", value=value,
                             allowed=allowed)  # fmt: skip
    package = re.sub(r"[-_.]+", "_", name).lower()
    of_suites = {entry.value for entry in entry_points(group=GROUP)}
    if package not in of_suites and find_spec(package) is not None:
        raise InputError("is the name of another package", where="--name", value=name,
                         allowed="such as lscan-suites")  # fmt: skip
    suites: dict[str, bytes] = {}
    for archive in archives:
        if archive.is_dir():
            raise InputError("is a folder", where=archive, allowed="a suite's archive")
        suite = verify_suite(archive).content.name
        if suite in suites:
            raise InputError("two suites have one name", where=archive, value=suite)
        suites[suite] = read_bytes(archive, MOST_SUITE_BYTES)
    make_folder(folder)
    file = folder / f"{package}-{version}-py3-none-any.whl"
    write_atomically(file, _wheel(package, name, version, suites))
    return file


def _wheel(package: str, name: str, version: str, suites: Mapping[str, bytes]) -> bytes:
    info = f"{package}-{version}.dist-info"
    named = ", ".join(sorted(suites))
    members = {
        f"{package}/__init__.py": f'"""Suites of lscan: {named}."""\n'.encode(),
        **{f"{package}/{suite}.zip": data for suite, data in sorted(suites.items())},
        f"{info}/METADATA": (
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
            f"Summary: Rendered pictures with their truth, for lscan: {named}\n"
            "Requires-Python: >=3.11\nRequires-Dist: lscan\n"
        ).encode(),
        f"{info}/WHEEL": (
            f"Wheel-Version: 1.0\nGenerator: lscan {__version__}\n"
            "Root-Is-Purelib: true\nTag: py3-none-any\n"
        ).encode(),
        f"{info}/entry_points.txt": "\n".join(
            [f"[{GROUP}]", *(f"{suite} = {package}" for suite in sorted(suites)), ""]
        ).encode(),
    }
    record = f"{info}/RECORD"
    lines = [f"{path},{_checksum(data)},{len(data)}" for path, data in members.items()]
    members[record] = "\n".join([*lines, f"{record},,", ""]).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as wheel:
        for path, data in members.items():
            wheel.writestr(zipfile.ZipInfo(path), data)  # of 1980, whatever the clock says
    return stream.getvalue()


def _checksum(data: bytes) -> str:
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest())
    return f"sha256={digest.rstrip(b'=').decode()}"
