"""The track moved by hand: what is asked, and what answers are taken."""

import re
from collections.abc import Iterator

import pytest
from device_contract import TrackContract

from lscan.config.rig import parse_rig
from lscan.devices.api import Track
from lscan.devices.manual import ManualOptions, ManualTrack, track_driver
from lscan.errors import DeviceError, InputError

OPTIONS = ManualOptions(min_mm=0.0, max_mm=300.0)


class Operator:
    """Types given answers, in turn, and remembers the questions."""

    def __init__(self, *answers: str) -> None:
        self.answers, self.questions = list(answers), list[str]()

    def __call__(self, question: str) -> str:
        self.questions.append(question)
        if not self.answers:
            raise EOFError
        return self.answers.pop(0)


class TestManualTrack(TrackContract):
    limits_mm = (0.0, 300.0)
    tolerance_mm = 0.5
    name = "manual track"

    @pytest.fixture
    def track(self) -> Iterator[Track]:
        yield ManualTrack(OPTIONS, Operator("12", *[""] * 10))


def test_the_operator_is_asked_to_move_and_may_read_another_value() -> None:
    operator = Operator("0", "", "20.3")
    track = ManualTrack(OPTIONS, operator)
    assert track.move_to(10.0) == 10.0
    assert track.move_to(20.0) == 20.3
    assert track.position_mm == 20.3
    assert "crank to 10 mm" in operator.questions[1]


def test_answers_that_are_no_reading_are_asked_for_again() -> None:
    operator = Operator("here", "", "nan", "0", "1o", "inf", "100", "10.5")
    track = ManualTrack(OPTIONS, operator)
    assert track.move_to(10.0) == 10.5
    assert re.search(r"100 mm is more than 0.5 mm off", operator.questions[-1])


def test_stopping_and_a_terminal_that_ends_leave_the_position() -> None:
    for answers, message in ((("0", "q"), "stopped by the operator"), (("0",), "no answer")):
        track = ManualTrack(OPTIONS, Operator(*answers))
        with pytest.raises(DeviceError, match=message):
            track.move_to(10.0)
        assert track.position_mm == 0.0


@pytest.mark.parametrize(
    "values", [{}, {"min_mm": 1, "max_mm": 0}, {"min_mm": 0, "max_mm": 1, "tolerance_mm": 0}]
)
def test_wrong_options_are_refused(values: dict[str, float]) -> None:
    track = {"driver": "manual", "options": values}
    rig_file = parse_rig(
        {"camera": {"driver": "x"}, "track": track}, source="rig.toml", trusted=True
    )
    with pytest.raises(InputError, match=r"rig.toml: track.options"):
        track_driver.validate(rig_file)
