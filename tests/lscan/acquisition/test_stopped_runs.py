"""A run that stopped: what the error says is kept, and what may be added to it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fake_devices import FakeCamera, FakeTrack, fake_rig, folder_bytes

from lscan.acquisition.run import open_run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run, resume_run
from lscan.errors import DeviceError, InputError
from lscan.files.cache import long_work_shown
from lscan.records import Progress


def stopped_run(path: Path, frames: int) -> pytest.ExceptionInfo[DeviceError]:
    """The error that stopped a scan of five frames after ``frames``."""
    track = FakeTrack()
    with (
        pytest.raises(DeviceError) as stopped,
        create_run(path, fake_rig()) as writer,
    ):
        acquire_into(writer, FakeCamera(track, fail_at=frames), track)
    return stopped


@pytest.mark.parametrize("frames", [0, 3])
def test_the_error_notes_what_is_kept(tmp_path: Path, frames: int) -> None:
    path = tmp_path / "a"
    stopped = stopped_run(path, frames)
    note = f"{frames} of 5 frames are kept in {path}; go on with --resume"
    assert stopped.value.__notes__ == [note]
    assert len(open_run(path)) == frames


def test_a_run_does_not_go_on_with_pictures_of_another_kind(tmp_path: Path) -> None:
    """Begun in colour, it is not resumed by a camera that sends grey; nor is it harmed."""
    path, track = tmp_path / "a", FakeTrack()
    stopped_run(path, 2)
    before = folder_bytes(path)
    with (
        pytest.raises(InputError, match=r"frame 2 is not like the frames before; set the camera"),
        resume_run(path, fake_rig()) as writer,
    ):
        acquire_into(writer, FakeCamera(track, colour=False), track)
    assert folder_bytes(path) == before
    with resume_run(path, fake_rig()) as writer:
        run = acquire_into(writer, FakeCamera(track), track)
    assert {frame.image.shape for frame in run.frames()} == {(16, 20, 3)}


def test_the_check_of_what_was_recorded_says_how_far_it_is(tmp_path: Path) -> None:
    """Before a run goes on, every picture is read: of a long one that takes minutes."""
    stopped_run(tmp_path / "a", 3)
    steps: list[tuple[str, int, int]] = []

    @contextmanager
    def shown(title: str) -> Iterator[Progress]:
        yield lambda done, every: steps.append((title, done, every))

    with long_work_shown(shown):
        resume_run(tmp_path / "a", fake_rig()).close()
    assert steps == [("recorded pictures checked", n, 3) for n in (1, 2, 3)]
