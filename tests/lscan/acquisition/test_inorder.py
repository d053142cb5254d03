"""Work on several items at once: order, errors, and an early end."""

import threading
import time

import pytest

from lscan.acquisition import inorder
from lscan.acquisition.inorder import in_order


@pytest.fixture(autouse=True)
def three_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inorder, "cores", lambda: 3)


def test_results_come_in_the_items_order() -> None:
    def late_first(item: int) -> int:
        time.sleep(0.01 * (item % 3 == 0))
        return -item

    assert list(in_order(late_first, range(20))) == [-item for item in range(20)]


def test_calls_overlap() -> None:
    """Each of three waits for the two others: one at a time would wait for ever."""
    together = threading.Barrier(3, timeout=30)
    assert sorted(in_order(lambda _: together.wait(), range(3))) == [0, 1, 2]


def test_an_error_comes_in_its_place_and_stops_the_rest() -> None:
    begun: list[int] = []

    def fails_at_four(item: int) -> int:
        begun.append(item)
        if item == 4:
            raise ValueError("four")
        return item

    results = in_order(fails_at_four, range(1000))
    assert [next(results) for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="four"):
        next(results)
    assert max(begun) < 20


def test_an_early_end_drops_what_has_not_begun() -> None:
    begun: list[int] = []
    results = in_order(begun.append, range(1000))
    next(results)
    results.close()
    count = len(begun)
    time.sleep(0.05)
    assert len(begun) == count < 20


def test_nothing_to_do() -> None:
    assert list(in_order(abs, [])) == []
