"""The run folder: what is written is what is read, and no damage passes unseen."""

import datetime
import hashlib
import json
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread, current_thread
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from fake_devices import FakeCamera, FakeTrack, fake_rig, folder_bytes
from hypothesis import given, strategies as st

from lscan.acquisition.run import FrameRow, Manifest, Run, first_difference, open_run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run
from lscan.config.rig import parse_rig
from lscan.errors import InputError
from lscan.files.disk import remove_temporaries, temporary_name, write_atomically
from lscan.records import Frame

FINITE = st.floats(allow_nan=False, allow_infinity=False)
ROWS = st.builds(
    FrameRow,
    index=st.integers(0, 10**6),
    commanded_mm=FINITE,
    position_mm=FINITE,
    time_s=FINITE,
    exposure_ms=FINITE,
    sha256=st.binary(min_size=32, max_size=32).map(bytes.hex),
)


def bits(row: FrameRow) -> list[bytes]:
    numbers = (row.commanded_mm, row.position_mm, row.time_s, row.exposure_ms)
    return [struct.pack("d", number) for number in numbers]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A complete run of four colour frames; tests that damage it take a copy."""
    with create_run(tmp_path_factory.mktemp("runs") / "a", fake_rig(frames=4)) as writer:
        track = FakeTrack()
        return acquire_into(writer, FakeCamera(track), track)


@pytest.fixture
def copy(recorded: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded.path, tmp_path / "copy"))


def test_a_run_is_shown_in_a_line(recorded: Run) -> None:
    expected = f"<Run {str(recorded.path)!r}: 'fake', 4 of 4 frames, complete>"
    assert repr(recorded) == expected.replace("fake", recorded.rig_file.rig.name)


# Rows


@examples(200)
@given(row=ROWS)
def test_a_row_reads_back_with_the_same_bits(row: FrameRow) -> None:
    back = FrameRow.from_text(row.as_text(), where="here")
    assert back == row
    assert bits(back) == bits(row)


@examples(200)
@given(row=ROWS, data=st.data())
def test_a_row_cut_anywhere_is_torn(row: FrameRow, data: st.DataObject) -> None:
    text = row.as_text()
    end = data.draw(st.integers(0, len(text) - 1))
    with pytest.raises(InputError, match="torn"):
        FrameRow.from_text(text[:end], where="here")


def test_a_row_of_numpy_numbers_is_written_as_plain_ones() -> None:
    number = np.float64(0.1)
    text = FrameRow(0, number, number, number, number, "ab").as_text()
    assert text.startswith("0,0.1,0.1,0.1,0.1,ab,")


# Pictures


@examples(30)
@given(seed=st.integers(0, 2**32 - 1), colour=st.booleans())
def test_pictures_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, seed: int, colour: bool
) -> None:
    shape = (16, 20, 3) if colour else (16, 20)
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    with create_run(tmp_path_factory.mktemp("run") / "a", fake_rig(frames=1)) as writer:
        writer.append(Frame(image, 0, 1.0, 1.0, 0.0, 20.0))
        run = writer.finish()
    np.testing.assert_array_equal(run.frame(0).image, image)


def test_colour_is_stored_the_right_way_round(tmp_path: Path) -> None:
    """OpenCV reads BGR: a red picture must have its 255 in the last channel."""
    image = np.zeros((16, 20, 3), np.uint8)
    image[..., 0] = 255
    with create_run(tmp_path / "a", fake_rig(frames=1)) as writer:
        writer.append(Frame(image, 0, 1.0, 1.0, 0.0, 20.0))
    stored = cv2.imread(str(tmp_path / "a" / "frames" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored[0, 0].tolist() == [0, 0, 255]


def test_a_run_says_what_it_holds(recorded: Run) -> None:
    # The fake track misses by 0.013 mm.
    np.testing.assert_allclose(recorded.positions_mm, 1.013 + 0.1 * np.arange(4), atol=1e-12)
    assert len(list(recorded.frames())) == len(recorded) == 4
    assert recorded.software[0].keys() == {"lscan", "python", "numpy", "opencv"}
    with pytest.raises(InputError, match=r"no such frame.*got 4.*0 to 3"):
        recorded.frame(4)


def test_frames_must_come_in_order(tmp_path: Path) -> None:
    image = np.zeros((16, 20), np.uint8)
    with create_run(tmp_path / "a", fake_rig(frames=1)) as writer:
        with pytest.raises(InputError, match="out of order"):
            writer.append(Frame(image, 1, 1.0, 1.0, 0.0, 20.0))
        with pytest.raises(InputError, match="frames are missing"):
            writer.finish()
        writer.append(Frame(image, 0, 1.0, 1.0, 0.0, 20.0))
        with pytest.raises(InputError, match="out of order"):
            writer.append(Frame(image, 1, 1.0, 1.0, 0.0, 20.0))
    with pytest.raises(InputError, match="closed"):
        writer.append(Frame(image, 1, 1.0, 1.0, 0.0, 20.0))
    writer.close()


# Damage, by chance


def meaning(run: Run) -> tuple[Any, ...]:
    return run.rows, run.state, run.software, run.rig_file.document, run.rig_file.rig


@examples(300)
@given(
    name=st.sampled_from(["run.json", "frames.csv", "frames/000002.png"]),
    place=st.floats(0, 1, exclude_max=True),
    flip=st.integers(1, 255),
)
def test_no_changed_byte_passes_unseen(
    recorded: Run, tmp_path_factory: pytest.TempPathFactory, name: str, place: float, flip: int
) -> None:
    """Each is an InputError, or (white space in run.json) changes nothing that is read."""
    file = recorded.path / name
    original = file.read_bytes()
    data = bytearray(original)
    data[int(place * len(data))] ^= flip
    file.write_bytes(data)
    try:
        run = open_run(recorded.path)
        run.verify()
        assert meaning(run) == meaning(recorded)
        assert name == "run.json"
    except InputError as error:
        assert file.name in str(error)
    finally:
        file.write_bytes(original)


# Damage, by kind: each names the file and, in the table, the line


def edit_table(change: Callable[[list[str]], list[str]]) -> Callable[[Path], object]:
    def damage(path: Path) -> None:
        table = path / "frames.csv"
        table.write_text("".join(change(table.read_text().splitlines(keepends=True))))

    return damage


def with_index(line: str, index: int) -> str:
    """The row with another index and the right checksum, as a careless tool would write it."""
    row = FrameRow.from_text(line.rstrip("\n"), where="here")
    return FrameRow(**{**vars(row), "index": index}).as_text() + "\n"


def edit_manifest(**changes: Any) -> Callable[[Path], object]:
    def damage(path: Path) -> None:
        file = path / "run.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))

    return damage


def other_size(path: Path) -> None:
    """A picture of another size whose checksum the table has."""
    done, data = cv2.imencode(".png", np.zeros((4, 4), np.uint8))
    assert done
    replace_picture(path, data.tobytes())


def replace_picture(path: Path, data: bytes) -> None:
    (path / "frames" / "000001.png").write_bytes(data)
    table = path / "frames.csv"
    lines = table.read_text().splitlines()
    row = FrameRow.from_text(lines[2], where="here")
    lines[2] = FrameRow(**{**vars(row), "sha256": hashlib.sha256(data).hexdigest()}).as_text()
    table.write_text("\n".join(lines) + "\n")


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no manifest": (lambda p: (p / "run.json").unlink(), r"not a run folder: it has no run\.json"),
    "no folder": (lambda p: shutil.rmtree(p), r"run\.json: cannot be read: No such file"),
    "empty manifest": (lambda p: (p / "run.json").write_text(""), r"run\.json: is not valid JSON"),
    "deep": (lambda p: (p / "run.json").write_text("[" * 10**5), r"run\.json: is not valid JSON"),
    "list": (lambda p: (p / "run.json").write_text("[]"), r"run\.json: is not a run manifest"),
    "not UTF-8": (lambda p: (p / "run.json").write_bytes(b"\xff"), r"run\.json: is not UTF-8"),
    "NaN": (lambda p: (p / "run.json").write_text('{"a": NaN}'), "NaN is not a number"),
    "edited": (edit_manifest(state="scanning"), r"run\.json: was changed after"),
    "later version": (edit_manifest(version=2), r"run\.json: version: .*got 2"),
    "other format": (edit_manifest(format="else"), r"run\.json: format: .*got 'else'"),
    "strange key": (edit_manifest(host="tank1"), r"run\.json: host: unknown key"),
    "no table": (lambda p: (p / "frames.csv").unlink(), r"frames\.csv: cannot be read"),
    "empty table": (lambda p: (p / "frames.csv").write_text(""), r"frames\.csv line 1: wrong head"),
    "other header": (edit_table(lambda r: ["index\n", *r[1:]]), r"frames\.csv line 1: wrong head"),
    "header alone": (edit_table(lambda r: [r[0].rstrip()]), r"frames\.csv line 1: .*torn"),
    "torn": (edit_table(lambda r: [*r[:-1], r[-1][:30]]), r"frames\.csv line 5: .*torn"),
    "twice": (edit_table(lambda r: [*r[:3], r[2], *r[3:]]), r"line 4: .*twice \(got 1; allowed: 2"),
    "skipped": (edit_table(lambda r: [*r[:2], *r[3:]]), r"line 3: .*skipped \(got 2; allowed: 1"),
    "swapped": (edit_table(lambda r: [*r[:2], r[3], r[2], r[4]]), r"line 3: .*skipped \(got 2"),
    "short": (
        edit_table(lambda r: r[:-1]),
        r"frames\.csv: the number of frames.*got 3; allowed: 4",
    ),
    "long": (
        edit_table(lambda r: [*r, with_index(r[-1], 4)]),
        r"frames\.csv: the number of frames.*got 5; allowed: 4",
    ),
    "no frames": (lambda p: shutil.rmtree(p / "frames"), r"frames: cannot be read"),
    "no frame": (lambda p: (p / "frames/000001.png").unlink(), r"000001\.png: missing.*line 3"),
    "changed frame": (
        lambda p: (p / "frames/000001.png").write_bytes(b"x"),
        r"000001\.png: is not the picture that frames\.csv line 3 lists",
    ),
    "other size": (
        other_size,
        r"000001\.png: wrong picture size \(got '4 by 4 px'; allowed: 20 by",
    ),
    "no picture": (lambda p: replace_picture(p, b"GIF"), r"000001\.png: is not an 8-bit"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_named(copy: Path, kind: str) -> None:
    damage, line = DAMAGE[kind]
    damage(copy)
    with pytest.raises(InputError, match=line) as caught:
        list(open_run(copy).frames())
    assert "\n" not in str(caught.value)


def test_a_row_with_a_number_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="does not hold what it should"):
        FrameRow.from_text(FrameRow(0, float("nan"), 0.0, 0.0, 0.0, "ab").as_text(), where="here")


# Manifest, documents, files


def test_a_plan_that_is_not_the_rigs_is_refused(copy: Path) -> None:
    """As when a later version reads the same rig with another default."""
    content = json.loads((copy / "run.json").read_text())
    content.pop("sha256")
    content["plan"]["step_mm"] = 0.2
    (copy / "run.json").write_text(Manifest.model_validate(content).as_text())
    with pytest.raises(InputError, match=r"run\.json: plan and rig\.plan differ"):
        open_run(copy)


def test_a_rig_that_json_cannot_hold_is_refused(tmp_path: Path) -> None:
    document = {**fake_rig().document, "tank": {"filled": datetime.date(2020, 1, 1)}}
    with pytest.raises(InputError, match="cannot keep"):
        create_run(tmp_path / "a", parse_rig(document, source="rig.toml", trusted=True))
    assert not (tmp_path / "a").exists()


def test_no_file_states_when_or_where(recorded: Run) -> None:
    manifest = json.loads((recorded.path / "run.json").read_text())
    assert manifest.keys() == {"format", "version", "state", "software", "plan", "rig", "sha256"}
    assert all(str(recorded.path).encode() not in d for d in folder_bytes(recorded.path).values())


@pytest.mark.parametrize(
    ("one", "other", "key"),
    [
        ({"a": {"b": [1, {"c": 2}]}}, {"a": {"b": [1, {"c": 3}]}}, "a.b[1].c"),
        ({"a": {"b": 1}}, {"a": {}}, "a.b"),
        ({"a": {}}, {"a": {"b": 1}}, "a"),
        ({"a": [1]}, {"a": [1, 2]}, "a[1]"),
        ({"a": 1}, {"a": 1.0}, "a"),
        ({"a": 1, "b": {"c": "x"}}, {"b": {"c": "x"}, "a": 1}, None),
    ],
)
def test_the_first_difference_is_named(one: Any, other: Any, key: str | None) -> None:
    assert first_difference(one, other) == key


def test_an_atomic_write_keeps_the_old_file_when_it_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    write_atomically(tmp_path / "a", b"old")
    monkeypatch.setattr("os.fsync", refuse)
    with pytest.raises(InputError, match="a: cannot be written: No space left"):
        write_atomically(tmp_path / "a", b"new")
    assert folder_bytes(tmp_path) == {"a": b"old"}


def test_what_a_killed_writer_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    killed, other = tmp_path / temporary_name("a"), tmp_path / ".notes.tmp"
    (tmp_path / temporary_name("folder")).mkdir()
    (tmp_path / temporary_name("link")).symlink_to(other)
    for file in (killed, other):
        file.write_bytes(b"half")
    remove_temporaries(tmp_path)
    assert folder_bytes(tmp_path) == {".notes.tmp": b"half"}
    assert list(tmp_path.iterdir()) == [other]


def test_of_two_writers_at_once_both_write_the_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second begins while the first has written nothing yet, and ends after it."""
    file, write, second_began, first_ended = tmp_path / "a", os.write, Event(), Event()
    second = Thread(target=write_atomically, args=(file, b"second"))

    def in_turn(descriptor: int, data: bytes) -> int:
        if current_thread() is second:
            second_began.set()
            first_ended.wait(60)
        else:
            second.start()
            second_began.wait(60)
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", in_turn)
    write_atomically(file, b"the first")
    assert file.read_bytes() == b"the first"
    first_ended.set()
    second.join(60)
    assert folder_bytes(tmp_path) == {"a": b"second"}
