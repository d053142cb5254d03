"""The system calls that write a run folder, made to fail on command."""

import errno
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

from lscan.files.disk import packaged_table

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
CALLS_A_FRAME = 8
"""open, write, fsync, rename, open and fsync of the folder; write and fsync of the row."""

REFUSED = packaged_table("sim.testing", "faults.toml")["disk"]
"""Kind of fault to the name of the error and the calls it refuses."""

PARTLY = frozenset({"disk full", "disk error", "disk pulled"})
"""Faults under which the write they hit still writes its first bytes."""


class FaultyDisk:
    """What lies beneath one run folder.

    on_call: called before each watched system call, with its number.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._aside = folder.with_name(f"{folder.name}.gone")
        self.on_call: Callable[[], None] = lambda: None
        self._descriptors: set[int] = set()
        self._kind, self._part = "", 0.0
        self._limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def inject(self, kind: str, strength: float) -> None:
        """Let a fault begin; strength, 0 to 1: which part of the first write still succeeds.

        folder vanished: it is renamed.  file size limit: the kernel's own, at ``strength``
        times 8 kB; a real refusal of the system, as of a full disk.
        """
        self._kind, self._part = kind, strength
        if kind == "folder vanished":
            with suppress(FileNotFoundError):
                self._folder.rename(self._aside)
        elif kind == "file size limit":
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(8000 * strength), self._limits[1]))

    def clear(self) -> None:
        """End the fault."""
        self._kind = ""
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)
        if self._aside.exists():
            self._aside.rename(self._folder)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Within the block the system calls on this folder go through this object."""
        calls = dict.fromkeys(("write", "fsync", "ftruncate", "close"), self._on_descriptor)
        calls |= dict.fromkeys(("open", "replace", "mkdir", "unlink"), self._on_path)
        with ExitStack() as patches:
            for name, watching in calls.items():
                call = watching(name, getattr(os, name))
                patches.enter_context(mock.patch.object(os, name, call))
            yield

    def _on_descriptor(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(descriptor: int, *args: Any) -> Any:
            if descriptor not in self._descriptors:
                return real(descriptor, *args)
            if name == "close":
                self._descriptors.discard(descriptor)
                return real(descriptor)
            self.on_call()
            if name == "write" and self._kind in PARTLY and self._part > 0:
                first = bytes(args[0])[: int(self._part * len(args[0]))]
                self._part = 0.0
                if first:
                    return real(descriptor, first)
            self._refuse(name)
            return real(descriptor, *args)

        return call

    def _on_path(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *args: Any, **kwargs: Any) -> Any:
            if not isinstance(path, str | Path) or not self._is_ours(Path(path)):
                return real(path, *args, **kwargs)
            self.on_call()
            if name != "open" or (args and args[0] & WRITING):
                self._refuse(name)
            result = real(path, *args, **kwargs)
            if name == "open":
                self._descriptors.add(result)
            return result

        return call

    def _is_ours(self, path: Path) -> bool:
        return path == self._folder or self._folder in path.parents

    def _refuse(self, name: str) -> None:
        refused = REFUSED.get(self._kind)
        if refused is not None and name in refused["calls"]:
            number = getattr(errno, refused["error"])
            raise OSError(number, os.strerror(number))
