"""Suites read without trust: a folder or an archive, each member checked before it is decoded."""

import base64
import hashlib
import io
import logging
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lscan.config.plugins import broken_plugin, find_entry, installed
from lscan.errors import InputError
from lscan.files.cache import cache_folder
from lscan.files.containers import ReadMember, open_zip
from lscan.files.disk import make_folder, read_bytes, write_atomically
from lscan.suites.content import (
    KINDS,
    MANIFEST,
    MOST_MANIFEST_BYTES,
    MOST_MEMBER_BYTES,
    MOST_SUITE_BYTES,
    TRUTH,
    BoardCase,
    CaseMembers,
    ScanCase,
    SuiteCase,
    SuiteContent,
    manifest_bytes,
    member_sum,
    read_manifest,
)
from lscan.version import __version__

# Suites written: members first, the manifest last; the same content gives the same bytes.


CaseAxes = Mapping[str, Mapping[str, str]]  # a value on each axis, by case
AnyCase = SuiteCase | BoardCase | ScanCase


def write_case(folder: Path, case: AnyCase) -> None:
    """Write the members of a case, its truth last; InputError where the disk refuses.

    Parameters
    ----------
    folder : Path, of the suite
    case : SuiteCase, BoardCase or ScanCase
    """
    make_folder(folder / case.name)
    for part, data in case.parts().items():
        write_atomically(folder / case.name / part, data)


def is_written(folder: Path, case: str) -> bool:
    """Whether a case has been written whole.

    Parameters
    ----------
    folder : Path, of the suite
    case : str, its name
    """
    return (folder / case / TRUTH).is_file()


def write_manifest(
    folder: Path,
    name: str,
    seed: int,
    made_by: str,
    cases: CaseAxes,
    boards: CaseAxes | None = None,
    scans: CaseAxes | None = None,
) -> SuiteContent:
    """Write the manifest of the members that lie in a folder, which makes it a suite.

    Parameters
    ----------
    folder : Path, of the cases' members
    name : str, of the suite
    seed : int, that it was made with
    made_by : str, the version of lscan and the spec's checksum
    cases : mapping, the axes of each picture of a line
    boards, scans : mapping or None, likewise of the board, and of whole scans
    """
    every = (*cases, *(boards or {}), *(scans or {}))
    files = sorted(file for case in every for file in (folder / case).iterdir())
    members = {
        f"{file.parent.name}/{file.name}": member_sum(read_bytes(file, MOST_MEMBER_BYTES, folder))
        for file in files
        if not file.name.startswith(".")
    }
    content = SuiteContent(
        name=name, seed=seed, made_by=made_by, members=members, cases=cases, boards=boards or {},
        scans=scans or {},
    )  # fmt: skip
    write_atomically(folder / MANIFEST, manifest_bytes(content))
    return content


def archive_bytes(content: SuiteContent, members: dict[str, bytes]) -> bytes:
    """The one archive of a suite's content: ZIP, stored, sorted, with a fixed date.

    Parameters
    ----------
    content : SuiteContent, the manifest
    members : mapping, the bytes of each member by its name
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, data in [(MANIFEST, manifest_bytes(content)), *sorted(members.items())]:
            archive.writestr(zipfile.ZipInfo(name), data)
    return stream.getvalue()


# Suites read without trust: a folder or an archive, each member checked before it is decoded.


@dataclass(frozen=True)
class Suite:
    """A suite that is open: its manifest has been checked, its members have not.

    Attributes
    ----------
    path : Path, of its folder or archive
    content : SuiteContent
    read : callable, a member's bytes unchecked
    """

    path: Path
    content: SuiteContent
    read: ReadMember

    def member(self, name: str) -> bytes:
        """The bytes of a member; InputError, which names it, where its checksum differs.

        Parameters
        ----------
        name : str, as in the manifest
        """
        stated = self.content.members[name]
        data = self.read(name, stated.size)
        if member_sum(data) != stated:
            raise InputError(f"member {name} is not what the manifest says", where=self.path)
        return data

    def case(self, name: str) -> Any:
        """A case, of a line, of the board, or a scan; InputError, which names a harmed member.

        Parameters
        ----------
        name : str, as in the manifest
        """
        for kind, cases in self.content.kinds.items():
            if name in cases:
                members = self.content.members
                return KINDS[kind].read(
                    CaseMembers(name, cases[name], self.path, members, self.member)
                )
        raise InputError("no such case", where=self.path, value=name)

    def cases(self) -> Iterator[SuiteCase]:
        """Each picture of a line in the order of their names."""
        return map(self.case, sorted(self.content.cases))

    def boards(self) -> Iterator[BoardCase]:
        """Each picture of the board in the order of their names."""
        return map(self.case, sorted(self.content.boards))

    def scans(self) -> Iterator[ScanCase]:
        """Each scan in the order of their names."""
        return map(self.case, sorted(self.content.scans))


def open_suite(path: Path) -> Suite:
    """The suite in a folder or an archive; InputError where its manifest is none.

    Parameters
    ----------
    path : Path
    """
    if path.is_dir():
        read: ReadMember = partial(_in_folder, path)
    else:
        read = open_zip(path, MOST_SUITE_BYTES, "suite")
    return Suite(path, read_manifest(read(MANIFEST, MOST_MANIFEST_BYTES), path), read)


def verify_suite(path: Path) -> Suite:
    """The suite, once every byte of it has been checked and every case been read.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        For the first member that is harmed, and bytes of an archive that belong to no member.
    """
    suite = open_suite(path)
    members = {name: suite.member(name) for name in suite.content.members}
    for cases in suite.content.kinds.values():
        for name in sorted(cases):
            suite.case(name)
    if not path.is_dir():
        written = archive_bytes(suite.content, members)
        if path.stat().st_size != len(written) or written != read_bytes(path, MOST_SUITE_BYTES):
            raise InputError("the archive's own entries are harmed", where=path)
    return suite


def pack_suite(folder: Path, file: Path) -> None:
    """Write a suite's folder, whose members are checked, as one archive.

    Parameters
    ----------
    folder : Path, of a suite
    file : Path, the archive; replaced where it is there
    """
    suite = open_suite(folder)
    members = {name: suite.member(name) for name in suite.content.members}
    write_atomically(file, archive_bytes(suite.content, members))


def _in_folder(folder: Path, name: str, most: int) -> bytes:
    return read_bytes(folder / name, most, within=folder)


# Suites by name: of installed packages, in the user's cache, or a path.


GROUP = "lscan.suites"

_log = logging.getLogger(__name__)


def suite_cache() -> Path | None:
    """The folder of suites that the user rendered; None where there is no cache."""
    cache = cache_folder()
    return None if cache is None else cache / "suites"


def suites_found() -> dict[str, Path]:
    """The suites by name; one of a package goes before one of the cache.

    An entry point of the group ``lscan.suites`` names a package; the suite is its file
    ``NAME.zip``, or its folder NAME.  One that cannot be loaded is left out, and the log says why.
    """
    found = _in_cache()
    for name in installed(GROUP):
        found.pop(name, None)
        try:
            found[name] = _of_package(name)
        except InputError as error:
            _log.warning("a suite is left out: %s", error)
    return found


def _in_cache() -> dict[str, Path]:
    cache = suite_cache()
    entries = sorted(cache.iterdir()) if cache is not None and cache.is_dir() else []
    return {entry.stem: entry for entry in entries if not entry.name.startswith(".")}


def _of_package(name: str) -> Path:
    """Where the suite of that name lies that a package brings."""
    entry = find_entry(GROUP, name, where=GROUP)
    try:
        folder = Path(str(files(entry.value)))
    except (Exception, SystemExit) as error:  # a package may raise anything
        raise broken_plugin(entry, error, where=GROUP) from error
    archive = folder / f"{name}.zip"
    return archive if archive.is_file() else folder / name


def find_suite(name: str) -> Path:
    """Where a suite lies.

    Parameters
    ----------
    name : str, of a suite that is found, or a path

    Raises
    ------
    InputError
        There is none.
    """
    if name in installed(GROUP):
        return _of_package(name)
    if found := _in_cache().get(name):
        return found
    if Path(name).exists():
        return Path(name)
    allowed = (
        ", ".join(suites_found()) or f"a path; lscan-sim suite make {name} renders one of that name"
    )
    raise InputError("no such suite", where="--suite", value=name, allowed=allowed)


# Suites published as a package: a wheel of data alone, which lscan finds by its entry point.


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
