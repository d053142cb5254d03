"""The results of a study in a folder: found by their rows, whole after a kill, of one study."""

import errno
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lscan.errors import InputError
from lscan.records import Floats
from sim.studies.problem import Output
from sim.studies.run.store import (
    MANIFEST,
    OK,
    RECORDS,
    Batch,
    Results,
    StudyIdentity,
    open_store,
    require_same_document,
)

STUDY = StudyIdentity({"scene": "a.toml", "cause": {"x": 1}}, ("a", "b"), (Output("z", "mm", 3),))
NAN = np.nan


def batch(rows: Floats) -> Batch:
    """Three values of each row; those whose first number is beyond 0.9 fail."""
    good = ~(rows[:, 0] > 0.9)
    values = np.where(good[:, None], np.nan_to_num(rows).sum(axis=1)[:, None] * [1, 2, 3], NAN)
    return Batch(rows, Results(values, tuple(OK if one else "no line: é" for one in good)), 0.0)


def some_rows(count: int, seed: int = 3) -> Floats:
    rows = np.random.default_rng(seed).random((count, 2))
    rows[0] = NAN
    return rows


def test_results_come_in_the_order_of_the_rows_whatever_theirs_was(tmp_path: Path) -> None:
    rows = some_rows(50)
    with open_store(tmp_path, STUDY) as store:
        for part in np.array_split(np.random.default_rng(4).permutation(50), 7):
            store.append([batch(rows[part])])
        got = store.results(rows)
    expected = batch(rows).results
    assert got.values.tobytes() == expected.values.tobytes()
    assert got.status == expected.status
    with open_store(tmp_path, STUDY) as store:
        assert store.results(rows[::-1]).values.tobytes() == expected.values[::-1].tobytes()
        assert len(store.missing(rows)) == 0


def test_a_row_is_missing_once_and_whatever_its_zero_and_its_nan_are(tmp_path: Path) -> None:
    other_nan = np.frombuffer(np.uint64(0xFFF8000000000001).tobytes())[0]
    rows = np.array([[0.5, 0.0], [NAN, 0.1], [0.5, -0.0], [other_nan, 0.1], [0.1, 0.2]])
    with open_store(tmp_path, STUDY) as store:
        np.testing.assert_array_equal(store.missing(rows), rows[[0, 1, 4]])
        store.append([batch(rows[:2])])
        np.testing.assert_array_equal(store.missing(rows), rows[4:])
        assert len(store) == 2


def test_a_file_cut_anywhere_keeps_the_records_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # takes long, and is no matter here
    rows = some_rows(4)
    with open_store(tmp_path, STUDY) as store:
        ends = [0]
        for n in range(4):
            store.append([batch(rows[[n]])])
            ends.append((tmp_path / RECORDS).stat().st_size)
    whole = (tmp_path / RECORDS).read_bytes()
    for length in range(len(whole) + 1):
        (tmp_path / RECORDS).write_bytes(whole[:length])
        with open_store(tmp_path, STUDY) as store:
            kept = sum(end <= length for end in ends[1:])
            np.testing.assert_array_equal(store.missing(rows), rows[kept:])
            store.append([batch(rows[kept:])])
        assert (tmp_path / RECORDS).read_bytes() == whole


@pytest.mark.parametrize("tail", [bytes(200), b"\xff" * 200], ids=["zeros", "ones"])
def test_what_a_power_failure_leaves_behind_is_cut_off(
    tmp_path: Path, tail: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    rows = some_rows(4)
    with open_store(tmp_path, STUDY) as store:
        store.append([batch(rows)])
    whole = (tmp_path / RECORDS).read_bytes()
    (tmp_path / RECORDS).write_bytes(whole + tail)
    with open_store(tmp_path, STUDY) as store:
        assert store.results(rows).values.tobytes() == batch(rows).results.values.tobytes()
    assert (tmp_path / RECORDS).read_bytes() == whole
    assert "last 200 bytes are damaged" in caplog.text


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (replace(STUDY, document={"scene": "b.toml"}), "document"),
        (replace(STUDY, causes=("a", "c")), "causes"),
        (replace(STUDY, outputs=(Output("z", "mm", 4),)), "outputs"),
        (replace(STUDY, version="0.0.1"), "version"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_another_study_is_refused_and_both_are_named(
    tmp_path: Path, other: StudyIdentity, named: str
) -> None:
    open_store(tmp_path, STUDY).close()
    with pytest.raises(InputError, match=f"differs in its {named}") as caught:
        open_store(tmp_path, other)
    assert STUDY.sha256 in str(caught.value)
    assert other.sha256 in str(caught.value)
    open_store(tmp_path, STUDY).close()  # whose lock was let go


def test_a_study_of_another_document_is_told_before_anything_is_made(tmp_path: Path) -> None:
    require_same_document(tmp_path, {"scene": "b.toml"})  # nothing is there yet
    open_store(tmp_path, STUDY).close()
    require_same_document(tmp_path, {"scene": "a.toml"})
    with pytest.raises(InputError, match=r"another study, which differs in its document\.scene"):
        require_same_document(tmp_path, {"scene": "b.toml"})


def test_the_order_of_the_documents_keys_makes_no_other_study(tmp_path: Path) -> None:
    open_store(tmp_path, STUDY).close()
    turned = replace(STUDY, document=dict(reversed(STUDY.document.items())))
    open_store(tmp_path, turned).close()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"sha256": "0"}'])
def test_a_manifest_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(InputError, match=MANIFEST):
        open_store(tmp_path, STUDY)


def test_a_second_process_is_refused(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from lscan.errors import InputError\n"
        "from sim.studies.run.store import StudyIdentity, open_store\n"
        "try: open_store(Path(sys.argv[1]), StudyIdentity({}, (), ()))\n"
        "except InputError as error: print(error)\n"
    )
    with open_store(tmp_path, STUDY):
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
    assert done.stdout == f"{tmp_path}: is being written by another study\n", done.stderr


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_told_from_another_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Lustre without its flock option says ENOSYS, NFS without its lock service ENOLCK."""

    def no_lock(descriptor: int, how: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", no_lock)
    with pytest.raises(InputError) as refused:
        open_store(tmp_path, STUDY)
    told = f"{tmp_path}: cannot be locked against another study: {os.strerror(number)}"
    assert str(refused.value).startswith(told)
    assert "a file system with flock" in str(refused.value)


def test_a_disk_that_is_full_leaves_what_was_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = some_rows(6)
    real = os.write

    def half(descriptor: int, data: bytes) -> int:
        real(descriptor, bytes(data)[: len(data) // 2])
        raise OSError(28, "No space left on device")

    with open_store(tmp_path, STUDY) as store:
        store.append([batch(rows[:2])])
        with monkeypatch.context() as patched:
            patched.setattr(os, "write", half)
            with pytest.raises(InputError, match="make room"):
                store.append([batch(rows[2:])])
        np.testing.assert_array_equal(store.missing(rows), rows[2:])
        store.append([batch(rows[2:])])
        assert store.results(rows).values.tobytes() == batch(rows).results.values.tobytes()
