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

CaseAxes = Mapping[str, Mapping[str, str]]  # a value on each axis, by case


def write_case(folder: Path, case: SuiteCase | BoardCase) -> None:
    """Write the members of a case, its truth last; InputError where the disk refuses.

    Parameters
    ----------
    folder : Path, of the suite
    case : SuiteCase or BoardCase
    """
    make_folder(folder / case.name)
    members = board_members(case) if isinstance(case, BoardCase) else case_members(case)
    for name, data in members.items():
        write_atomically(folder / name, data)


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
) -> SuiteContent:
    """Write the manifest of the members that lie in a folder, which makes it a suite.

    Parameters
    ----------
    folder : Path, of the cases' members
    name : str, of the suite
    seed : int, that it was made with
    made_by : str, the version of lscan and the spec's checksum
    cases : mapping, the axes of each picture of a line
    boards : mapping or None, likewise of the board
    """
    boards = boards or {}
    files = sorted(file for case in (*cases, *boards) for file in (folder / case).iterdir())
    members = {
        f"{file.parent.name}/{file.name}": member_sum(read_bytes(file, MOST_MEMBER_BYTES, folder))
        for file in files
        if not file.name.startswith(".")
    }
    content = SuiteContent(
        name=name, seed=seed, made_by=made_by, cases=cases, boards=boards, members=members
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
