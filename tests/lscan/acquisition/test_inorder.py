"""Work on several items at once: order, errors, and an early end."""

import runpy
import threading
import time
from pathlib import Path

import pytest

from lscan.acquisition import scan as inorder
from lscan.acquisition.scan import in_order
from lscan.errors import InputError


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


GUARD = 'if __name__ == "__main__":\n    '


@pytest.mark.parametrize(
    ("body", "refused_at"),
    [
        ("require_guarded_main()", 3),
        ("def work():\n    require_guarded_main()\n\n\nwork()", 7),
        ("if True:\n    require_guarded_main()", 4),
        (f"{GUARD}require_guarded_main()", None),
        (f"def work():\n    require_guarded_main()\n\n\n{GUARD}work()", None),
    ],
)
def test_processes_are_started_beneath_the_main_guard_of_a_script(
    tmp_path: Path, body: str, refused_at: int | None
) -> None:
    script = tmp_path / "script.py"
    script.write_text(f"from lscan.acquisition.scan import require_guarded_main\n\n{body}\n")
    if refused_at is None:
        runpy.run_path(str(script), run_name="__main__")
        return
    with pytest.raises(InputError) as caught:
        runpy.run_path(str(script), run_name="__main__")
    assert str(caught.value).startswith(f"{script} line {refused_at}: starts processes")
    assert 'if __name__ == "__main__":' in str(caught.value)


@pytest.mark.parametrize(
    ("ask", "given"),
    [
        ("from lscan.benchmark.suiterun import judge_shared as asked", "'none', [], []"),
        ("from sim.studies.executor import open_workers as asked", "2"),
    ],
)
def test_all_that_starts_processes_asks_for_the_main_guard(
    tmp_path: Path, ask: str, given: str
) -> None:
    script = tmp_path / "script.py"
    script.write_text(f"{ask}\nstarted = asked({given})\nstarted.__enter__()\n")
    with pytest.raises(InputError, match="starts processes"):
        runpy.run_path(str(script), run_name="__main__")
