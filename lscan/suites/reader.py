"""Suites read without trust: a folder or an archive, each member checked before it is decoded."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.files.containers import ReadMember, open_zip
from lscan.files.disk import read_bytes, write_atomically
from lscan.files.pictures import read_png
from lscan.suites.boards import BoardCase, read_board_case
from lscan.suites.content import (
    DARK,
    LABELS,
    LAYERS,
    MANIFEST,
    MOST_MANIFEST_BYTES,
    MOST_SUITE_BYTES,
    PICTURE,
    SETTINGS,
    TRUTH,
    SuiteCase,
    SuiteContent,
    member_sum,
    read_manifest,
    read_section,
    read_truth,
)
from lscan.suites.layers import layers_of_picture
from lscan.suites.scans import ScanCase, read_scan_case
from lscan.suites.writer import archive_bytes


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

    def case(self, name: str) -> SuiteCase:
        """A case; InputError, which names the member, where it is harmed.

        Parameters
        ----------
        name : str, as in the manifest
        """
        if name not in self.content.cases:
            raise InputError("no such case", where=self.path, value=name)

        def shown(part: str) -> tuple[bytes, str]:
            return self.member(f"{name}/{part}"), f"{self.path}: member {name}/{part}"

        picture, labels = read_png(*shown(PICTURE)), read_png(*shown(LABELS))
        has_dark = f"{name}/{DARK}" in self.content.members
        dark = read_png(*shown(DARK)) if has_dark else None
        has_layers = f"{name}/{LAYERS}" in self.content.members
        light = read_png(*shown(LAYERS)) if has_layers else None
        truth, settings = read_truth(*shown(TRUTH)), read_section(StripeSection, *shown(SETTINGS))
        along = picture.shape[1] if settings.axis == "columns" else picture.shape[0]
        sizes = labels.shape == picture.shape[:2] and len(truth.status) == along
        sizes &= dark is None or dark.shape == picture.shape
        if not sizes or (light is not None and light.shape != (*labels.shape, 3)):
            raise InputError(f"members of case {name} differ in size", where=self.path)
        layers = None if light is None else layers_of_picture(light)
        axes = self.content.cases[name]
        return SuiteCase(name, axes, picture, dark, labels, truth, settings, layers)

    def board(self, name: str) -> BoardCase:
        """A picture of the board; InputError, which names the member, where it is harmed.

        Parameters
        ----------
        name : str, as in the manifest
        """
        if name not in self.content.boards:
            raise InputError("no such case", where=self.path, value=name)
        return read_board_case(name, self.content.boards[name], self.member, self.path)

    def scan(self, name: str) -> ScanCase:
        """A whole scan; InputError, which names the member, where it is harmed.

        Parameters
        ----------
        name : str, as in the manifest
        """
        if name not in self.content.scans:
            raise InputError("no such case", where=self.path, value=name)
        axes, has = self.content.scans[name], self.content.members.__contains__
        return read_scan_case(name, axes, self.member, has, self.path)

    def boards(self) -> Iterator[BoardCase]:
        """Each picture of the board in the order of their names."""
        return (self.board(name) for name in sorted(self.content.boards))

    def cases(self) -> Iterator[SuiteCase]:
        """Each case in the order of their names."""
        return (self.case(name) for name in sorted(self.content.cases))

    def scans(self) -> Iterator[ScanCase]:
        """Each scan in the order of their names."""
        return (self.scan(name) for name in sorted(self.content.scans))


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
    for cases in (suite.cases(), suite.boards(), suite.scans()):
        deque(cases, maxlen=0)
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
