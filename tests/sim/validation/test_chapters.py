"""Chapters of figures side by side: each process gets its share of the threads that render."""

import os

import pytest

from sim.render.backend import THREADS
from sim.validation import chapters


@pytest.mark.parametrize(
    "cores, workers, said, expected",
    [(2, 2, None, "1"), (8, 3, None, "2"), (2, 3, None, "1"), (2, 2, "2", "2")],
)
def test_threads_are_shared_unless_the_user_says_otherwise(
    cores: int, workers: int, said: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chapters, "cores", lambda: cores)
    monkeypatch.setenv(THREADS, said or "")  # and taken back at the end, whatever is set meanwhile
    if said is None:
        monkeypatch.delenv(THREADS)
    chapters._share_threads(workers)
    assert os.environ[THREADS] == expected
