"""Rows evaluated anywhere: the same bytes, nothing twice, failures told, whatever is killed."""

import logging
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster

from lscan.errors import InputError, LscanError
from lscan.records import Floats
from sim.studies.executor import (
    KILLED,
    Workers,
    in_order,
    open_workers,
    package_versions,
    workers_of,
)
from sim.studies.results import OK, Results, ResultStore, distinct_rows, identity_of, open_store
from sim.studies.running import TARGET_S, Batches, cost_estimate, prepared_of, run_rows
from tests.validation.studies.running import (
    ROWS,
    StubSource,
    evaluated,
    killed_study,
    result_bytes,
    served_scheduler,
    started_study,
    stub_rows,
    stub_study,
)

FAILING = 0.05


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Workers]:
    with open_workers(2) as workers:
        yield workers


@pytest.fixture
def source(tmp_path: Path) -> StubSource:
    """A stub that keeps a log, and fails in 5 % of the rows."""
    return StubSource(failing=FAILING, log=str(tmp_path / "log"))


@pytest.fixture(scope="module")
def in_threads() -> Iterator[Client]:
    """A cluster as another's is: reached by its address, though it is in this process."""
    with (
        LocalCluster(
            n_workers=1, processes=False, protocol="tcp", dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def opened(source: StubSource, folder: Path) -> ResultStore:
    return open_store(folder / "store", identity_of(source))


def in_one_process(source: StubSource, rows: Floats, folder: Path) -> Results:
    quiet = StubSource(failing=source.failing)
    with open_store(folder / "alone", identity_of(quiet)) as store:
        return run_rows(quiet, rows, store)


def test_results_do_not_depend_on_the_workers(
    source: StubSource, tmp_path: Path, two_workers: Workers
) -> None:
    rows = stub_rows(300)
    steps: list[tuple[int, int]] = []
    with opened(source, tmp_path) as store:
        found = run_rows(
            source, rows, store, two_workers, progress=lambda *step: steps.append(step)
        )
    assert result_bytes(found) == result_bytes(in_one_process(source, rows, tmp_path))
    assert sorted(evaluated(source)) == sorted(row.tobytes() for row in distinct_rows(rows))
    assert steps[-1] == (299, 299)
    assert [done for done, _ in steps] == sorted({done for done, _ in steps})


def test_a_design_that_grows_evaluates_what_is_new_alone(
    source: StubSource, tmp_path: Path
) -> None:
    rows = stub_rows(40)
    with opened(source, tmp_path) as store:
        run_rows(source, rows[:25], store)
        found = run_rows(source, rows[::-1], store)
    assert result_bytes(found) == result_bytes(in_one_process(source, rows[::-1], tmp_path))
    assert len(evaluated(source)) == len(distinct_rows(rows))


def test_a_row_that_fails_has_a_status_and_a_fault_is_logged_once(
    source: StubSource, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = np.column_stack([np.linspace(0.0, 0.1, 41), np.full((41, 2), 0.5)])
    with opened(source, tmp_path) as store, caplog.at_level(logging.ERROR):
        found = run_rows(source, rows, store)
    assert found.status[0] == "no line at 0.000000"
    assert found.status[12] == "error: ZeroDivisionError: at 0.030000"
    assert found.status[20:] == (OK,) * 21
    assert np.isnan(found.values[:20]).all()
    assert np.isfinite(found.values[20:]).all()
    assert caplog.text.count("Traceback") == 1


@pytest.mark.slow
def test_a_row_that_kills_its_worker_costs_no_other(tmp_path: Path, two_workers: Workers) -> None:
    source = StubSource(killing=0.98)
    rows = np.column_stack([np.linspace(0.0, 0.9, 8), np.full((8, 2), 0.5)])
    rows[5, 0] = 0.99
    with opened(source, tmp_path) as store:
        found = run_rows(source, rows, store, two_workers)
    assert found.status == (OK,) * 5 + (KILLED,) + (OK,) * 2
    alone = in_one_process(StubSource(), np.delete(rows, 5, axis=0), tmp_path)
    assert np.delete(found.values, 5, axis=0).tobytes() == alone.values.tobytes()
    assert np.isnan(found.values[5]).all()


def test_a_study_knows_its_files_by_what_they_hold(tmp_path: Path) -> None:
    """Rows of another mesh of the same name are another study's, whatever else is the same."""

    class MeshSource:
        document: Mapping[str, object] = MappingProxyType(
            {"scan": {"target": {"file": str(tmp_path / "mesh.stl")}}}
        )
        make = StubSource().make

    (tmp_path / "mesh.stl").write_bytes(b"one")
    with open_store(tmp_path / "store", identity_of(MeshSource())):
        pass
    (tmp_path / "mesh.stl").write_bytes(b"another")
    with pytest.raises(InputError, match=r"differs in its document\.scan\.target\.file"):
        open_store(tmp_path / "store", identity_of(MeshSource()))


def test_what_was_prepared_is_kept_for_the_same_files_and_version_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[bytes] = []

    def prepared(study: object) -> SimpleNamespace:
        made.append(f"{len(made)}".encode())
        return SimpleNamespace(packed=lambda: made[-1])

    monkeypatch.setattr("sim.studies.running.prepare", prepared)
    scene = SimpleNamespace(document={"target": {"file": str(tmp_path / "mesh.stl")}})
    study: Any = SimpleNamespace(calibrate=scene, scan=scene, file=SimpleNamespace(places=()))

    def found() -> bytes:
        return prepared_of(study, tmp_path / "prepared.npz", lambda _: None)

    (tmp_path / "mesh.stl").write_bytes(b"one")
    assert [found(), found()] == [b"0", b"0"]
    (tmp_path / "mesh.stl").write_bytes(b"another")
    assert [found(), found()] == [b"1", b"1"]
    monkeypatch.setattr("sim.studies.running.__version__", "99.0")
    assert found() == b"2"


def test_a_design_that_is_larger_than_agreed_is_refused(source: StubSource, tmp_path: Path) -> None:
    rows = stub_rows(20)
    with opened(source, tmp_path) as store:
        with pytest.raises(InputError, match=r"--at-most: too many runs \(got 19; allowed: 18\)"):
            run_rows(source, rows, store, at_most=18)
        assert not evaluated(source)
        run_rows(source, rows, store, at_most=19)


def test_a_cost_estimate_is_that_of_what_is_left(tmp_path: Path) -> None:
    """A sleep is never shorter than asked for; how much longer depends on the machine."""
    source = StubSource(row_s=0.02, log=str(tmp_path / "log"))
    rows = stub_rows(30)
    with opened(source, tmp_path) as store:
        cost = cost_estimate(source, rows, store, workers=2)
        assert cost.rows == 29 - len(store) == 29 - len(evaluated(source))
        assert cost.row_s >= 0.02
        assert cost.seconds >= cost.rows * cost.row_s / 2
        run_rows(source, rows, store)
        assert cost_estimate(source, rows, store).seconds == 0
    assert len(evaluated(source)) == 29


def test_batches_take_as_long_as_they_should() -> None:
    rows = np.arange(5000.0)[:, None]
    batches = Batches(rows)
    sizes = []
    seen = []
    for batch in batches:
        seen.append(batch)
        sizes.append(len(batch))
        batches.learn(len(batch), 0.003 * len(batch))
    np.testing.assert_array_equal(np.concatenate(seen), rows)
    assert sizes[:4] == [1, 4, 16, 64]
    assert sizes[4:-1] == [int(TARGET_S / 0.003)] * (len(sizes) - 5)


@pytest.mark.slow
@pytest.mark.parametrize(("what", "part"), [("worker", 0.5), ("study", 0.4)])
def test_what_is_killed_is_gone_on_with(tmp_path: Path, what: str, part: float) -> None:
    source = StubSource(row_s=0.02, failing=FAILING)
    expected = result_bytes(in_one_process(source, stub_rows(ROWS), tmp_path))
    after_s = part * ROWS * source.row_s
    found = killed_study(source, tmp_path / "run", what, after_s, expected)
    assert found.killed
    assert found.same
    assert found.repeated == 0


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_what_ends_a_study_leaves_the_store_sound_and_no_process(
    tmp_path: Path, sent: signal.Signals
) -> None:
    source = StubSource(row_s=0.02, log=str(tmp_path / "log"))
    study = started_study(source, tmp_path / "store", 5000, "2")
    deadline_s = time.monotonic() + 60
    while len(evaluated(source)) < 50 and time.monotonic() < deadline_s:
        time.sleep(0.05)
    children = psutil.Process(study.pid).children(recursive=True)
    if sent == signal.SIGINT:  # as a terminal does: to the workers, too
        os.killpg(study.pid, sent)
    else:
        os.kill(study.pid, sent)
    said, wrong = study.communicate(timeout=60)
    assert study.returncode == 3, wrong
    assert said.strip().endswith("go on with --resume")
    assert not wrong
    assert psutil.wait_procs(children, timeout=10)[1] == []
    with opened(source, tmp_path) as store:
        assert 0 < len(store) <= len(evaluated(source))


def test_a_ctrl_c_that_a_destructor_swallows_ends_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python tells nobody of what is raised in one."""

    class Swallowing:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    done: list[int] = []

    def swallowed(count: int, every: int) -> None:
        done.append(count)
        if len(done) == 2:
            Swallowing()

    source = StubSource()
    with opened(source, tmp_path) as store, pytest.raises(KeyboardInterrupt):
        run_rows(source, stub_rows(200), store, progress=swallowed)
    assert len(told) == 1 and len(done) == 2


@pytest.mark.slow
def test_another_scheduler_works_and_its_end_is_told(tmp_path: Path) -> None:
    source = StubSource(failing=FAILING)
    with served_scheduler() as (address, scheduler):

        def end_at_20(done: int, every: int) -> None:
            if done > 20:
                scheduler.kill()

        found = stub_study(source, tmp_path / "store", 40, address)
        expected = in_one_process(source, stub_rows(40), tmp_path)
        assert result_bytes(found) == result_bytes(expected)
        with open_workers(scheduler=address) as workers:
            slow = StubSource(row_s=0.05)
            with (
                pytest.raises(LscanError, match=r"the scheduler at .* is gone") as caught,
                opened(slow, tmp_path / "slow") as store,
            ):
                run_rows(slow, stub_rows(500), store, workers, progress=end_at_20)
    assert "go on with --resume" in caught.value.__notes__[0]


def test_the_workers_of_a_study_answer_nobody_else(two_workers: Workers) -> None:
    """Whoever is answered can have any code run: they have no socket at all."""
    worker = psutil.Process(two_workers.submit(os.getpid).result())
    assert worker in psutil.Process().children()
    assert worker.net_connections("all") == []


@pytest.mark.parametrize("name", ["lscan", "drjit"])
def test_a_worker_of_another_version_is_refused_before_its_first_row(
    source: StubSource,
    tmp_path: Path,
    in_threads: Client,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    mine = iter([{**package_versions(), name: "99.0"}])  # the workers are asked later
    monkeypatch.setattr(
        "sim.studies.executor.package_versions", lambda: next(mine, package_versions())
    )
    (address,) = in_threads.nthreads()
    told = f"the worker at {address}: has another version of {name} .got .*; allowed: 99.0, as here"
    with opened(source, tmp_path) as store, pytest.raises(InputError, match=told):
        run_rows(source, stub_rows(20), store, workers_of(in_threads))
    assert evaluated(source) == []


def test_a_worker_that_cannot_look_for_itself_is_asked_for_its_lscan(
    in_threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim.studies.executor.__version__", "99.0")
    told = r"the worker at tcp://\S+: has another version of lscan \(got .*; allowed: 99.0"
    with (
        pytest.raises(InputError, match=told),
        open_workers(scheduler=in_threads.scheduler.address),
    ):
        pass


def on_another_disk(link: Path) -> Iterator[Path]:
    """What is done, by workers that see another folder at a path, as if it were another disk."""
    link.unlink()
    link.symlink_to(link.with_name("theirs"))
    yield link


def test_a_worker_with_another_disk_of_the_same_name_is_refused(
    tmp_path: Path, in_threads: Client
) -> None:
    for name in ("ours", "theirs"):
        (tmp_path / name).mkdir()
    folder, workers = tmp_path / "shared", workers_of(in_threads)
    folder.symlink_to(tmp_path / "ours")
    assert list(in_order(workers, str, [folder], str, folder=folder)) == [str(folder)]
    told = r"the worker at .* has another folder of the same name .got '/.*/shared'"
    with pytest.raises(InputError, match=told):
        list(in_order(workers, Path.touch, on_another_disk(folder), str, folder=folder))
    assert list((tmp_path / "theirs").iterdir()) == []
    folder.unlink()
    folder.symlink_to(tmp_path / "ours")
    assert list(in_order(workers, str, [folder], str, folder=folder)) == [str(folder)]
    assert list(folder.iterdir()) == []  # nor is the marker of the refused call left


def test_a_worker_with_another_file_of_the_same_name_is_refused(
    tmp_path: Path, in_threads: Client
) -> None:
    mesh, workers = tmp_path / "mesh.stl", workers_of(in_threads)
    for content, told in ((b"theirs", "has another file"), (None, "or none")):
        mesh.unlink(missing_ok=True)
        if content is not None:
            mesh.write_bytes(content)
        with pytest.raises(InputError, match=f"the worker at .*{told}.*mesh.stl"):
            list(in_order(workers, str, [1], str, files={str(mesh): "0" * 64}))


def test_a_cluster_whose_workers_leave_gets_fewer_calls(two_workers: Workers) -> None:
    """Of eight workers one stays: what was under way is more than it is given."""
    most = iter([8, 1])
    leaving = replace(two_workers, most=lambda: next(most, 1))
    assert list(in_order(leaving, abs, range(-20, 0), str)) == list(range(20, 0, -1))


def test_it_is_told_where_no_worker_can_do_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else every row would be said to kill its worker, and be kept so."""
    monkeypatch.setattr("sim.studies.executor._end_with_parent", os.abort)
    with open_workers(1) as workers, pytest.raises(LscanError, match="cannot evaluate any row"):
        list(in_order(workers, abs, [-1], str))


def test_no_scheduler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.studies.executor.CONNECT_S", 0.5)
    with (
        pytest.raises(InputError, match="--scheduler: no scheduler answers"),
        open_workers(scheduler="tcp://127.0.0.1:1"),
    ):
        pass
