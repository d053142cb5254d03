"""What holds for every reading of a stranger's file: a refusal in one line, little memory and time.

All that is hostile is harmless: what lies outside is a FIFO that nobody writes to, so that whoever
opens it is caught by the clock, and what is large is a hole.
"""

import os
import resource
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lscan.errors import InputError

MOST_MIB = 200  # beyond what was there before
HANG_S = 20
LARGE = 2**40


@pytest.fixture
def little_memory_and_time(request: pytest.FixtureRequest) -> None:
    """The test itself, but not what pytest says of it, has little of both."""
    run = request.node.runtest

    def limited() -> None:
        with _little_memory_and_time():
            run()

    request.node.runtest = limited


@contextmanager
def _little_memory_and_time() -> Iterator[None]:
    """No more address space than there is now and MOST_MIB, and an alarm for who waits."""

    def hangs(*_: Any) -> None:
        raise AssertionError(f"still at work after {HANG_S} s")

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before, most = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + MOST_MIB * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, most))
    handler = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, (before, most))


def refusal(read: Callable[[], Any], name: str, said: str = "") -> None:
    """The reading is refused in one line that names the file and says why."""
    with pytest.raises(InputError) as caught:
        read()
    line = str(caught.value)
    assert name in line
    assert said in line
    assert "\n" not in line
    assert "written" not in line, "nothing was to be written"


# What stands in the place of a file


def a_fifo(file: Path) -> None:
    os.mkfifo(file)


def a_device(file: Path) -> None:
    file.symlink_to("/dev/zero")


def a_loop(file: Path) -> None:
    file.symlink_to(file.name)


def a_folder(file: Path) -> None:
    file.mkdir()


def a_socket(file: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        here = Path.cwd()
        os.chdir(file.parent)  # its path may be too long for a socket
        one.bind(file.name)
        os.chdir(here)


def a_large_hole(file: Path) -> None:
    file.touch()
    os.truncate(file, LARGE)


# What stands in the place of an array of HDF5: the group it is to be in, its name and shape, and
# a file outside

Shape = tuple[int, ...]


def external_link(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    group[name] = h5py.ExternalLink(str(outside), name)


def soft_link(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    group[name] = h5py.SoftLink(f"{group.name}/{name}")


def external_storage(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    group.create_dataset(name, shape, float, external=[(str(outside), 0, h5py.h5f.UNLIMITED)])


def virtual(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    layout = h5py.VirtualLayout(shape, float)
    layout[:] = h5py.VirtualSource(str(outside), name, shape)
    group.create_virtual_dataset(name, layout)


def a_group(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    group.create_group(name)


def terabytes(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    """No chunk is stored, and the file stays as small as it was."""
    ones = [1] * (len(shape) - 1)
    group.create_dataset(name, (LARGE, *ones), float, chunks=(10, *ones))


def large_chunk(group: h5py.Group, name: str, shape: Shape, outside: Path) -> None:
    chunks = (2**31, *[1] * (len(shape) - 1))
    any_shape = (None,) * len(shape)
    group.create_dataset(name, shape, np.uint8, chunks=chunks, maxshape=any_shape)


NOT_IN_THE_FILE = (external_link, soft_link, external_storage, virtual, a_group)
TOO_LARGE = (terabytes, large_chunk)


def moved_elsewhere(path: Path, outside: Path) -> None:
    """The same beside ``outside``, and a link to it in its place."""
    moved = outside.with_name("moved") / path.name
    moved.parent.mkdir()
    shutil.move(path, moved)
    path.symlink_to(moved)
