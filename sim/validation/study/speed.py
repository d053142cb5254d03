"""How long a budget of twelve causes takes in the geometric tier."""

import tempfile
import time
from pathlib import Path

import numpy as np

from lscan.records import Floats
from sim.studies.run.executor import open_client, run_rows
from sim.studies.run.store import identity_of, open_store
from sim.validation.rows import Row, row
from sim.validation.study.twelve import assumed, scan_places, source_of, twelve

RIGS = 14_336  # 1024 base samples of 12 causes
MINUTES = {"graticule-2": 5.0, "refractive": 20.0}
PARTS = 5  # timed one by one: their spread says what else the machine did
SEED = 14


def speed_rows(rows: int, workers: int = 2) -> list[Row]:
    """Minutes that 14,336 rigs take with either map, from fewer.

    Parameters
    ----------
    rows : int, rigs that are timed, at least as many as there are PARTS
    workers : int, processes
    """
    found = []
    for plane_map, bar in MINUTES.items():
        minutes = RIGS / 60 * seconds_a_row(plane_map, rows, workers)
        words = {"plane_map": plane_map, "workers": workers, "rows": rows, "rigs": RIGS}
        words |= {"low": minutes.min(), "high": minutes.max()}
        figure = float(np.median(minutes))
        found.append(row("study-speed", figure, bar=bar, seed=SEED, **words))
    return found


def seconds_a_row(plane_map: str, rows: int, workers: int) -> Floats:
    """(PARTS,) s of wall time a row, once every worker has made its problem.

    Parameters
    ----------
    plane_map : str
    rows : int, in all parts
    workers : int, processes
    """
    study = twelve(plane_map)
    source = source_of(study, assumed(study, scan_places()))
    numbers = np.random.default_rng(SEED).random((rows + 2 * workers, len(study.causes)))
    with tempfile.TemporaryDirectory(prefix="lscan-study-") as name, open_client(workers) as client:
        client.wait_for_workers(workers)
        with open_store(Path(name), identity_of(source)) as store:
            run_rows(source, numbers[rows:], store, client)
            seconds = []
            for part in np.array_split(numbers[:rows], PARTS):
                began_s = time.perf_counter()
                run_rows(source, part, store, client)
                seconds.append((time.perf_counter() - began_s) / len(part))
    return np.array(seconds)
