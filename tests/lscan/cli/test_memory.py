"""What the command lines ask of the C library, and of one that cannot."""

import ctypes

import pytest

from lscan.cli.console import keep_freed_memory


def test_glibc_is_asked_to_keep_what_is_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []

    class Library:
        def mallopt(self, *what: int) -> int:
            asked.append((what[0], what[1]))
            return 1

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library())
    keep_freed_memory()
    assert [name for name, _ in asked] == [-3, -1]  # M_MMAP_THRESHOLD and M_TRIM_THRESHOLD


@pytest.mark.parametrize("error", [OSError, TypeError])
def test_another_c_library_is_left_alone(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(name: object) -> object:
        raise error

    monkeypatch.setattr(ctypes, "CDLL", fails)
    keep_freed_memory()
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    keep_freed_memory()
