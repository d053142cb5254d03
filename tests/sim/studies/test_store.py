"""The results of a study in a folder: found by their rows, whole after a kill, of one study."""

import errno
import os
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lscan.errors import DiskError, InputError
from lscan.records import Floats
from sim.studies.problem import Output
from sim.studies.results import (
    FORMER,
    MANIFEST,
    OK,
    RECORDS,
    Batch,
    Results,
    ResultStore,
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


def killed_copy(store: ResultStore, folder: Path) -> Path:
    """What a process leaves behind that is killed now; of it, what is not yet in the database."""
    shutil.copytree(store.folder, folder)
    return folder / f"{RECORDS}-wal"


def test_a_file_cut_anywhere_keeps_the_records_before(tmp_path: Path) -> None:
    rows = some_rows(4)
    with open_store(tmp_path / "store", STUDY) as store:
        ends = []
        for n in range(4):
            store.append([batch(rows[[n]])])
            ends.append((tmp_path / "store" / f"{RECORDS}-wal").stat().st_size)
        whole = killed_copy(store, tmp_path / "whole").read_bytes()
    anywhere = np.random.default_rng(5).integers(ends[0], ends[-1], 12).tolist()
    for length in sorted(
        {*anywhere, *ends, *(end - 1 for end in ends), *(end + 1 for end in ends)}
    ):
        folder = tmp_path / f"{length}"
        shutil.copytree(tmp_path / "whole", folder)
        (folder / f"{RECORDS}-wal").write_bytes(whole[:length])
        with open_store(folder, STUDY) as store:
            kept = sum(end <= length for end in ends)
            np.testing.assert_array_equal(store.missing(rows), rows[kept:])
            store.append([batch(rows[kept:])])
            found = store.results(rows)
        assert found.values.tobytes() == batch(rows).results.values.tobytes()


@pytest.mark.parametrize("tail", [bytes(9000), b"\xff" * 9000], ids=["zeros", "ones"])
def test_what_a_power_failure_leaves_behind_is_not_read(tmp_path: Path, tail: bytes) -> None:
    rows = some_rows(4)
    with open_store(tmp_path / "store", STUDY) as store:
        store.append([batch(rows)])
        written = killed_copy(store, tmp_path / "killed")
    written.write_bytes(written.read_bytes() + tail)
    with open_store(tmp_path / "killed", STUDY) as store:
        assert store.results(rows).values.tobytes() == batch(rows).results.values.tobytes()


def test_a_bit_that_flips_costs_its_row_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = some_rows(6)
    with open_store(tmp_path, STUDY) as store:
        store.append([batch(rows)])
    data = bytearray((tmp_path / RECORDS).read_bytes())
    data[data.index(batch(rows[[3]]).results.values.tobytes()) + 5] ^= 1
    (tmp_path / RECORDS).write_bytes(data)
    with open_store(tmp_path, STUDY) as store:
        np.testing.assert_array_equal(store.missing(rows), rows[[3]])
    assert "1 rows are damaged" in caplog.text


@pytest.mark.parametrize("content", [b"no database" * 400, b"SQLite format 3\0" * 400])
def test_a_file_that_is_no_database_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / RECORDS).write_bytes(content)
    with pytest.raises(InputError, match=rf"{RECORDS}: .*choose another folder"):
        open_store(tmp_path, STUDY)
    assert (tmp_path / RECORDS).read_bytes() == content


def test_results_of_an_earlier_lscan_are_told_and_left_as_they_are(tmp_path: Path) -> None:
    (tmp_path / FORMER).touch()
    for opening in (
        lambda: open_store(tmp_path, STUDY),
        lambda: require_same_document(tmp_path, STUDY.document),
    ):
        with pytest.raises(InputError, match=r"an earlier lscan.*another folder"):
            opening()
    assert [file.name for file in tmp_path.iterdir()] == [FORMER]


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").touch()
    (tmp_path / RECORDS).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="instead of a link"):
        open_store(tmp_path, STUDY)
    assert (tmp_path / "elsewhere").stat().st_size == 0


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


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    told = f"{tmp_path}: is being written by another study"
    with open_store(tmp_path, STUDY), pytest.raises(InputError, match=told):
        open_store(tmp_path, StudyIdentity({}, (), ()))


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK])
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


@pytest.mark.parametrize("refused_by", ["the disk", "the limit for the size of files"])
def test_a_disk_that_is_full_leaves_what_was_kept(tmp_path: Path, refused_by: str) -> None:
    rows = some_rows(400)
    with open_store(tmp_path, STUDY) as store:
        store.append([batch(rows[:2])])
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        pages = store.database.execute("PRAGMA page_count").fetchone()[0]
        try:
            if refused_by == "the disk":
                store.database.execute(f"PRAGMA max_page_count = {pages}")
            else:
                size = (tmp_path / f"{RECORDS}-wal").stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (size + 1000, limits[1]))
            with pytest.raises(DiskError, match=rf"{RECORDS}: .*make room on the disk"):
                store.append([batch(rows[2:])])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            store.database.execute("PRAGMA max_page_count = 1000000")
        np.testing.assert_array_equal(store.missing(rows), rows[2:])
        store.append([batch(rows[2:])])
        assert store.results(rows).values.tobytes() == batch(rows).results.values.tobytes()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("what", ["folder", "file"])
def test_what_may_not_be_written_is_told(tmp_path: Path, what: str) -> None:
    open_store(tmp_path, STUDY).close()
    place, mode = (tmp_path, 0o500) if what == "folder" else (tmp_path / RECORDS, 0o400)
    place.chmod(mode)
    try:
        with pytest.raises(InputError, match=r"make .* writable"):
            open_store(tmp_path, STUDY)
    finally:
        place.chmod(0o700)
