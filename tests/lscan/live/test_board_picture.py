"""The board picture of the live page: where it is taken, and what is left where it is not."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from fake_devices import FakeTrack, fake_rig
from live_rig import Bench, live_bench, wait_for

from lscan.acquisition.run import open_run
from lscan.config.rig import RigFile, parse_rig
from lscan.errors import DeviceError
from lscan.live.session import Session


@dataclass
class ShortTrack(FakeTrack):
    """Refuses to go beyond 0 to 179 mm, but says so to nobody who does not try."""

    def move_to(self, position_mm: float) -> float:
        """Move; a DeviceError beyond the travel."""
        if not 0.0 <= position_mm <= 179.0:
            raise DeviceError(f"short track: cannot move to {position_mm} mm")
        return super().move_to(position_mm)


@dataclass
class LimitedTrack(ShortTrack):
    """States its travel."""

    limits_mm: tuple[float, float] = (0.0, 179.0)
    tolerance_mm: float = 0.02


def board_rig() -> RigFile:
    """The rig of the fake devices with a board, which their noise does not show."""
    board = {"grid": {"columns": 4, "rows": 3, "pitch_mm": 10.0, "dot_diameter_mm": 4.0}}
    document = {**fake_rig().document, "board": board}
    return parse_rig(document, source="rig.toml", trusted=True)


def board_session(bench: Bench) -> Session:
    """A session of that rig."""
    session = Session(board_rig(), bench.output)
    bench.sessions.append(session)
    return session


def picture_error(session: Session) -> str:
    """What the page says once the board picture is over."""
    session.take_board()
    wait_for(lambda: not session.state()["task"]["name"])
    message: str = session.state()["task"]["message"]
    return message


@pytest.mark.parametrize(
    ("track", "commanded_mm"),
    [
        (LimitedTrack(position_mm=180.0), 179.0),
        (LimitedTrack(position_mm=-2.0), 0.0),
        (LimitedTrack(position_mm=42.0), 42.0),
        (ShortTrack(position_mm=42.0), 42.0),
        (ShortTrack(position_mm=180.0), 1.0),  # the start of the plan
    ],
)
def test_it_is_taken_where_the_head_stands_or_nearest_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, track: FakeTrack, commanded_mm: float
) -> None:
    with live_bench(monkeypatch, tmp_path, track) as bench:
        message = picture_error(board_session(bench))
    run = open_run(tmp_path / "board-001")  # kept, though noise shows no board
    assert [frame.commanded_mm for frame in run.frames()] == [commanded_mm], message


def test_a_failure_is_shown_until_the_mode_is_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with live_bench(monkeypatch, tmp_path) as bench:
        session = board_session(bench)
        session.set_mode("board")
        assert picture_error(session)
        assert session.state()["task"]["message"]
        session.set_mode("stripe")
        assert session.state()["task"] == {"name": "", "message": ""}


def test_no_folder_is_left_where_no_picture_was_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "runs"
    with live_bench(monkeypatch, output, LimitedTrack(fail_at=0)) as bench:
        assert "limit switch" in picture_error(board_session(bench))
    assert not list(output.iterdir())
