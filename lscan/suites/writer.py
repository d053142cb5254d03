"""Suites written: members first, the manifest last; the same content gives the same bytes."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

from lscan.files.disk import make_folder, read_bytes, write_atomically
from lscan.suites.boards import BoardCase, board_members
from lscan.suites.content import (
    MANIFEST,
    MOST_MEMBER_BYTES,
    TRUTH,
    SuiteCase,
    SuiteContent,
    case_members,
    manifest_bytes,
    member_sum,
)
from lscan.suites.scans import ScanCase, scan_members

CaseAxes = Mapping[str, Mapping[str, str]]  # a value on each axis, by case


def write_case(folder: Path, case: SuiteCase | BoardCase | ScanCase) -> None:
    """Write the members of a case, its truth last; InputError where the disk refuses.

    Parameters
    ----------
    folder : Path, of the suite
    case : SuiteCase, BoardCase or ScanCase
    """
    make_folder(folder / case.name)
    for name, data in _members(case).items():
        write_atomically(folder / name, data)


def _members(case: SuiteCase | BoardCase | ScanCase) -> dict[str, bytes]:
    if isinstance(case, SuiteCase):
        return case_members(case)
    return board_members(case) if isinstance(case, BoardCase) else scan_members(case)


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
    boards, scans = boards or {}, scans or {}
    every = (*cases, *boards, *scans)
    files = sorted(file for case in every for file in (folder / case).iterdir())
    members = {
        f"{file.parent.name}/{file.name}": member_sum(read_bytes(file, MOST_MEMBER_BYTES, folder))
        for file in files
        if not file.name.startswith(".")
    }
    content = SuiteContent(
        name=name,
        seed=seed,
        made_by=made_by,
        cases=cases,
        boards=boards,
        scans=scans,
        members=members,
    )
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
