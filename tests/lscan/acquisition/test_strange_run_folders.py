"""A run folder of a stranger: it is read, or refused in one line; it harms nobody."""

import hashlib
import json
import shutil
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
import strange
from command_line import call, refused
from fake_devices import FakeCamera, FakeTrack, fake_rig
from png_files import HUGE, grey_png
from strange import refusal

from lscan.acquisition.run import FrameRow, Manifest, Run, open_run
from lscan.acquisition.scan import acquire_into, open_devices, scan
from lscan.acquisition.writer import create_run, resume_run
from lscan.config.rig import RigFile, parse_rig
from lscan.errors import InputError
from lscan.files import disk
from lscan.files.disk import write_atomically

FRAMES = 4


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A complete run of four frames; tests that change it take a copy."""
    return record(tmp_path_factory.mktemp("runs") / "a", fake_rig(frames=FRAMES))


def record(path: Path, rig_file: RigFile) -> Run:
    with create_run(path, rig_file) as writer:
        track = FakeTrack()
        return acquire_into(writer, FakeCamera(track), track)


@pytest.fixture
def copy(recorded: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded.path, tmp_path / "copy"))


@pytest.fixture
def scanning(copy: Path) -> Path:
    """The run as a killed scan leaves it: not complete, its last row missing."""
    sign(copy, state="scanning")
    rows = (copy / "frames.csv").read_text().splitlines(keepends=True)
    (copy / "frames.csv").write_text("".join(rows[:-1]))
    return copy


pytestmark = pytest.mark.usefixtures("little_memory_and_time")
little_memory_and_time = strange.little_memory_and_time


def sign(path: Path, rig: dict[str, Any] | None = None, **changes: Any) -> None:
    """Change run.json as who knows the format does: with the right checksum."""
    content = json.loads((path / "run.json").read_text())
    content.pop("sha256")
    content.update(changes)
    content["rig"].update(rig or {})
    (path / "run.json").write_text(Manifest.model_validate(content).as_text())


def read_all(path: Path) -> None:
    list(open_run(path).frames())


# What stands in a file's place

NAMES = ("run.json", "frames.csv", "frames/000001.png")


NO_FILE = {
    strange.a_fifo: "cannot be read: it is a FIFO (allowed: a regular file)",
    strange.a_folder: "cannot be read: it is a folder (allowed: a regular file)",
    strange.a_device: "is a link that leads out of",
    strange.a_loop: "cannot be read: Too many levels of symbolic links",
    strange.a_large_hole: "is too large: bytes (got 1099511627776; allowed: ",
}


@pytest.mark.parametrize(
    ("name", "attack"),
    [(NAMES[-1], attack) for attack in NO_FILE] + [(name, strange.a_fifo) for name in NAMES[:-1]],
)
def test_only_regular_files_are_read(copy: Path, name: str, attack: Callable[[Path], None]) -> None:
    (copy / name).unlink()
    attack(copy / name)
    refusal(lambda: read_all(copy), f"{copy / name}: {NO_FILE[attack]}")


@pytest.mark.parametrize("name", NAMES)
def test_a_file_is_read_from_the_folder_alone(copy: Path, tmp_path: Path, name: str) -> None:
    """The same file, beside the run folder: only where it lies is wrong."""
    strange.moved_elsewhere(copy / name, tmp_path / "outside")
    refusal(lambda: read_all(copy), f"{copy / name}: is a link that leads out of")


def test_a_link_to_a_folder_of_frames_elsewhere_is_refused(copy: Path, tmp_path: Path) -> None:
    shutil.move(copy / "frames", tmp_path / "elsewhere")
    (copy / "frames").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"frames: is a link that leads out of .*copy it there"):
        open_run(copy)


def test_links_to_the_folder_and_within_it_are_followed(copy: Path, tmp_path: Path) -> None:
    (copy / "frames" / "000001.png").rename(copy / "frames" / "other.png")
    (copy / "frames" / "000001.png").symlink_to("other.png")
    (tmp_path / "linked").symlink_to(copy)
    run = open_run(tmp_path / "linked")
    assert len(list(run.frames())) == FRAMES


def test_a_table_longer_than_its_plan_can_be_is_not_read(copy: Path) -> None:
    with (copy / "frames.csv").open("ab") as table:
        table.write(b"\n" * 10_000)
    with pytest.raises(InputError, match=r"frames\.csv: is too large: bytes \(got 10"):
        open_run(copy)


# Pictures


@pytest.mark.parametrize("size", [(HUGE, HUGE), (2**16, 2**15), (20, 17)])
def test_a_frame_is_of_the_rigs_size_before_it_is_decoded(
    copy: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    def reached(*_: Any) -> None:
        raise AssertionError("it was decoded")

    bomb = grey_png(*size, zlib.compress(bytes(1000)))
    (copy / "frames" / "000001.png").write_bytes(bomb)
    list_frame(copy, 1, bomb)
    run = open_run(copy)
    monkeypatch.setattr(cv2, "imdecode", reached)
    with pytest.raises(InputError) as caught:
        run.frame(1)
    expected = f"wrong picture size (got '{size[0]} by {size[1]} px'; allowed: 20 by 16 px"
    assert expected in str(caught.value)


def list_frame(path: Path, index: int, data: bytes) -> None:
    """Write into the table that frame ``index`` is that file."""
    table = path / "frames.csv"
    lines = table.read_text().splitlines()
    row = FrameRow.from_text(lines[index + 1], where="here")
    digest = hashlib.sha256(data).hexdigest()
    lines[index + 1] = FrameRow(**{**vars(row), "sha256": digest}).as_text()
    table.write_text("\n".join(lines) + "\n")


# Code

COMMANDS: dict[str, Callable[[Path], tuple[object, ...]]] = {
    "reconstruct": lambda run: ("reconstruct", run, "-c", "c.json", "-o", run / "s.nc"),
    "measure": lambda run: ("measure", run, "-c", "c.json"),
    "report": lambda run: ("report", "--board", run, "-o", run / "report"),
    "report, groove": lambda run: ("report", "--board", "a", "--groove", run, "-o", run / "report"),
    "extract": lambda run: ("extract", run),
    "calibrate": lambda run: ("calibrate", run, "-o", run / "c.json"),
    "check": lambda run: ("check", "c.json", run),
    "calibrate-shaft": lambda run: ("calibrate-shaft", run, "-c", "c.json", "-o", run / "s.toml"),
}


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of an extractor whose module is seen in sys.modules once it was run."""
    name = "of_a_stranger"
    (tmp_path / f"{name}.py").write_text("from lscan.stripe.rules import centroid\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield f"{name}:centroid"
    sys.modules.pop(name, None)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_runs_a_run_folders_code(
    recorded: Run,
    copy: Path,
    evil: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    if command == "check":  # it reads its calibration first, which is of no concern here
        monkeypatch.setattr("lscan.calibration.calibrationfile.load_any", lambda path: None)
    sign(copy, {"stripe": {"extractor": evil}})
    arguments = [recorded.path if part == "a" else part for part in COMMANDS[command](copy)]
    result = call(capsys, *arguments)
    refused(result, f"{copy}/run.json: stripe.extractor: ", f"got '{evil}'", "--trust", "centroid")
    assert "of_a_stranger" not in sys.modules
    code, _, err = call(capsys, *arguments, "--trust")
    assert "stripe.extractor" not in err, "what is trusted is not refused for it"
    assert command != "extract" or (code == 0 and "of_a_stranger" in sys.modules)


def test_a_run_is_resumed_and_replayed_with_code_of_the_users_own(
    tmp_path: Path, evil: str
) -> None:
    """The rig file is the user's; what a replay takes from a run is its pictures."""
    stripe = {"extractor": evil}
    rig = fake_rig(frames=FRAMES)
    rig = parse_rig({**rig.document, "stripe": stripe}, source="rig.toml", trusted=True)
    run = record(tmp_path / "a", rig)
    with resume_run(run.path, rig) as writer:
        assert len(writer.finish()) == FRAMES
    device = {"driver": "replay", "options": {"run_file": str(run.path)}}
    document = {**rig.document, "camera": {**rig.document["camera"], **device}, "track": device}
    replay = parse_rig({**document, "stripe": {}}, source="replay.toml", trusted=True)
    assert len(scan(replay, tmp_path / "b")) == FRAMES
    assert "of_a_stranger" not in sys.modules


@pytest.mark.parametrize("section", ["camera", "track"])
def test_a_run_folders_drivers_are_neither_imported_nor_opened(
    copy: Path, evil: str, section: str
) -> None:
    """A stranger's run may name any driver, since none is needed; code it cannot name."""
    rig = json.loads((copy / "run.json").read_text())["rig"]
    sign(copy, {section: {**rig[section], "driver": evil}})
    run = open_run(copy)
    assert "of_a_stranger" not in sys.modules
    with (
        pytest.raises(InputError, match=f"{section}.driver: no such {section} driver"),
        open_devices(parse_rig({**fake_rig().document, **_replayed(copy, run)}, "x", trusted=True)),
    ):
        pass
    assert "of_a_stranger" not in sys.modules


def _replayed(path: Path, run: Run) -> dict[str, Any]:
    """The sections of a run's rig, with whichever driver is not the stranger's replaced."""
    device = {"driver": "replay", "options": {"run_file": str(path)}}
    sections = {}
    for name in ("camera", "track"):
        own = run.rig_file.document[name]
        sections[name] = own if ":" in own["driver"] else {**own, **device}
    return sections


@pytest.mark.parametrize(
    ("rig", "key"),
    [
        ({"board": {"file": "/etc/passwd"}}, "board.grid"),
        ({"include": "/etc/passwd", "stripe": {"file": "/etc/passwd"}}, "stripe.file"),
        ({"calibration": {"plane_map": 1}}, "calibration.plane_map"),
    ],
)
def test_a_run_folders_paths_are_not_followed(copy: Path, rig: dict[str, Any], key: str) -> None:
    sign(copy, rig)
    with pytest.raises(InputError, match=rf"run\.json: {key}: "):
        open_run(copy)


def test_a_run_folder_too_deep_or_with_a_null_is_refused(copy: Path) -> None:
    deep: Any = 1
    for _ in range(60):
        deep = [deep]
    sign(copy, {"water": deep})
    with pytest.raises(InputError, match=r"run\.json: rig\.water\.0\.\.\.: .*too deep"):
        open_run(copy)
    sign(copy, {"water": "a\0b"})
    with pytest.raises(InputError, match=r"run\.json: rig\.water: holds a null character"):
        open_run(copy)


# Going on with a run: what is written stays in the folder

PRECIOUS = b"first line\nlast line without an end"


@pytest.fixture
def victim(tmp_path: Path) -> Iterator[Path]:
    """A file that is not of the run; whatever a test does, it stays as it is."""
    file = tmp_path / "precious"
    file.write_bytes(PRECIOUS)
    yield file
    assert file.read_bytes() == PRECIOUS


def go_on(path: Path) -> Run:
    with resume_run(path, fake_rig(frames=FRAMES)) as writer:
        track = FakeTrack()
        return acquire_into(writer, FakeCamera(track), track)


# The last as version 0.1 named them.
TEMPORARIES = [
    ".run.json.0123abcd.tmp",
    ".frames.csv.0123abcd.tmp",
    "frames/.000003.png.0123abcd.tmp",
    "frames/.000004.png.tmp",
]


@pytest.mark.parametrize("name", TEMPORARIES)
def test_temporary_files_that_are_links_are_not_followed(
    scanning: Path, victim: Path, name: str
) -> None:
    (scanning / name).symlink_to(victim)
    assert go_on(scanning).state == "complete"


@pytest.mark.parametrize("name", ["run.json", "frames.csv", "frames/000003.png"])
def test_no_link_is_laid_while_it_is_being_written(
    scanning: Path, victim: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Who guesses the temporary name makes the writing fail, and no more."""
    temporary = scanning / name
    temporary = temporary.with_name(f".{temporary.name}.guessed.tmp")
    temporary.symlink_to(victim)
    monkeypatch.setattr(disk, "temporary_name", lambda _: temporary.name)
    with pytest.raises(InputError, match="cannot be written: File exists"):
        write_atomically(scanning / name, b"overwritten")


def test_a_table_that_is_a_link_is_neither_cut_nor_added_to(scanning: Path, victim: Path) -> None:
    (scanning / "frames.csv").unlink()
    (scanning / "frames.csv").symlink_to(victim)
    with pytest.raises(InputError, match=r"frames\.csv: is a link that leads out of"):
        go_on(scanning)


def test_a_table_that_is_a_link_within_the_folder_is_not_added_to(scanning: Path) -> None:
    (scanning / "frames.csv").rename(scanning / "other.csv")
    (scanning / "frames.csv").symlink_to("other.csv")
    with pytest.raises(InputError, match=r"frames\.csv: cannot be written: .*put the file itself"):
        go_on(scanning)


@pytest.mark.parametrize("manifest", [True, False])
def test_frames_that_are_a_link_are_not_written_or_cleared(
    scanning: Path, tmp_path: Path, manifest: bool
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ".bashrc.tmp").write_bytes(PRECIOUS)
    shutil.rmtree(scanning / "frames")
    (scanning / "frames").symlink_to(elsewhere)
    if not manifest:
        (scanning / "run.json").unlink()
        (scanning / "frames.csv").unlink()
    with pytest.raises(InputError, match="frames: is a link that leads out of"):
        go_on(scanning)
    assert [file.name for file in elsewhere.iterdir()] == [".bashrc.tmp"]


def test_a_frame_that_is_a_link_is_replaced(scanning: Path, victim: Path) -> None:
    """The picture without a row that a killed scan left may be a link."""
    (scanning / "frames" / "000003.png").unlink()
    (scanning / "frames" / "000003.png").symlink_to(victim)
    assert go_on(scanning).state == "complete"
    assert not (scanning / "frames" / "000003.png").is_symlink()
