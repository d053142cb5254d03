"""Long work as it says how far it is."""

from collections.abc import Iterator
from contextlib import contextmanager

from lscan.records import Progress


class ShownWork:
    """What ``long_work_shown`` takes.  titles: of all work.  steps: (done, all) of all of it."""

    def __init__(self) -> None:
        self.titles: list[str] = []
        self.steps: list[tuple[int, int]] = []

    @contextmanager
    def __call__(self, title: str) -> Iterator[Progress]:
        self.titles.append(title)
        yield lambda done, every: self.steps.append((done, every))
