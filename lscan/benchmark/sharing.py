"""A suite's cases judged in several processes, a few at a time."""

import os
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lscan.acquisition.scan import require_guarded_main
from lscan.benchmark.judging import JudgedExtractor, judge, worst_of
from lscan.records import Progress
from lscan.suites import open_suite

AT_ONCE = 20  # cases
Part = tuple[list[JudgedExtractor], float]  # as ``judge`` returns it

_opened = lru_cache(1)(open_suite)


def judge_shared(
    path: Path, names: Sequence[str], cases: Sequence[str], progress: Progress | None = None
) -> Part:
    """As ``judge``, by a process for each core.

    Parameters
    ----------
    path : Path, of the suite
    names : sequence of str, of extractors, whose modules other processes can import
    cases : sequence of str, their names
    progress : callable or None, called with (done, all) cases
    """
    require_guarded_main()
    groups = [cases[first : first + AT_ONCE] for first in range(0, len(cases), AT_ONCE)]
    parts: list[Part] = []
    # None is forked: threads of OpenCV and BLAS may hold locks.
    spawned = get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), spawned, _leave_ctrl_c) as pool:
        for part in pool.map(partial(_judge_part, path, names), groups):
            parts.append(part)
            if progress is not None:
                progress(min(len(parts) * AT_ONCE, len(cases)), len(cases))
    judged = [_joined([part[0][n] for part in parts]) for n in range(len(names))]
    return judged, float(np.median([reference_s for _, reference_s in parts]))


def _judge_part(path: Path, names: Sequence[str], cases: Sequence[str]) -> Part:
    suite = _opened(path)
    return judge(names, (suite.case(case) for case in cases))


def _joined(parts: Sequence[JudgedExtractor]) -> JudgedExtractor:
    """What one extractor made of several groups of cases."""
    sums = {case: one for part in parts for case, one in part.sums.items()}
    worst = worst_of(column for part in parts for column in part.worst)
    return JudgedExtractor(parts[0].extractor, sums, worst)


def _leave_ctrl_c() -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
