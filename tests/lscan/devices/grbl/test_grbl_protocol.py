"""What Grbl says, read: the documented examples, and noise."""

import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.devices.grbl.dialogue import (
    CODES,
    Alarm,
    Banner,
    Feedback,
    GrblSetting,
    Ok,
    Refusal,
    StatusReport,
    in_words,
    parse_line,
    parse_status,
)
from lscan.devices.grbl.machine import LONGEST_ANSWER, Link
from lscan.errors import DeviceError

# ---- documented examples (Grbl 1.1 "Interface Basics") ----------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ok", Ok()),
        ("error:15", Refusal(15)),
        ("ALARM:9", Alarm(9)),
        ("Grbl 1.1h ['$' for help]", Banner("Grbl", "1.1h")),
        ("$110=500.000", GrblSetting(110, 500.0)),
        ("$10=255", GrblSetting(10, 255.0)),
        ("[MSG:Reset to continue]", Feedback("MSG", "Reset to continue")),
        ("[G54:0.000,0.000,0.000]", Feedback("G54", "0.000,0.000,0.000")),
        ("[PRB:0.000,0.000,0.000:0]", Feedback("PRB", "0.000,0.000,0.000:0")),
        ("[VER:v1.1d.20161014:Some string]", Feedback("VER", "v1.1d.20161014:Some string")),
        (">G54G20:ok", Feedback(">", "G54G20:ok")),
    ],
)
def test_documented_lines(text: str, message: object) -> None:
    assert parse_line(text) == message


def test_a_report_with_every_documented_field() -> None:
    text = (
        "<Hold:1|MPos:5.529,0.560,7.000|Bf:15,128|Ln:99999|FS:500,8000|WCO:0.000,1.551,5.664"
        "|Ov:100,50,120|A:SFM|Pn:XYZPDHRS>"
    )
    assert parse_line(text) == StatusReport(
        state="Hold",
        substate=1,
        machine=(5.529, 0.56, 7.0),
        offset=(0.0, 1.551, 5.664),
        pins="XYZPDHRS",
    )


def test_a_report_in_work_coordinates_and_one_with_a_field_of_another_firmware() -> None:
    assert parse_status("<Run|WPos:-2.500,0.000,11.000|F:500>") == StatusReport(
        state="Run", work=(-2.5, 0.0, 11.0)
    )
    status = parse_status("<Idle|MPos:0.000,0.000,0.000,1.000|SD:12.5>")
    assert status is not None
    assert status.machine == (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "OK",
        "okk",
        "error:",
        "error:x",
        "<Idle>",
        "<Idle|FS:0,0>",
        "<Idle|MPos:1.0,2.0",
        "Idle|MPos:1.0,2.0>",
        "<Idel|MPos:1.0,2.0,3.0>",
        "<Idle|MPos:1.0,,3.0>",
        "<Idle|MPos:1.0,2.0,3.0|MPos:1.0,2.0,3.0>",
        "<Idle|MPos:1.0|WPos:1.0>",
        "<Idle|MPos:nan,0,0>",
        "<Idle|MPos:1e3,0,0>",
        "<Idle|MPos:0,0,0|FS:1>",
        "<Idle|MPos:0,0,0|Ov:1,2>",
        "<Idle|MPos:0,0,0|Pn:1>",
        "$1=",
        "$x=1",
        "Grbl",
    ],
)
def test_what_is_no_message_is_noise(text: str) -> None:
    assert parse_line(text) is None


def test_every_documented_code_has_its_words() -> None:
    assert set(map(int, CODES["error"])) == {*range(1, 18), *range(20, 39)}
    assert set(map(int, CODES["ALARM"])) == set(range(1, 10))
    assert "travel" in in_words("error", 15)
    assert "position is lost" in in_words("ALARM", 3)
    assert "does not document" in in_words("error", 99)
    assert "does not document" in in_words("ALARM", 99)


places = st.floats(-9999, 9999).map(lambda mm: round(mm, 3))


@examples(100)
@given(place=st.tuples(places, places, places), state=st.sampled_from(["Idle", "Jog", "Alarm"]))
def test_a_report_written_is_a_report_read(place: tuple[float, ...], state: str) -> None:
    text = f"<{state}|MPos:{','.join(f'{mm:.3f}' for mm in place)}|FS:0,0>"
    status = parse_line(text)
    assert isinstance(status, StatusReport)
    assert status.state == state
    assert status.machine == place


@examples(100)
@given(text=st.text("<>|:,.$[]=-okIdleMPsFSWCO0123456789", max_size=40))
def test_no_text_breaks_the_parser(text: str) -> None:
    parse_line(text)


# ---- the line ---------------------------------------------------------------------------


class Wire:
    """Delivers given bytes in given pieces, then nothing; each empty read takes time."""

    def __init__(self, data: bytes, piece: int = 7) -> None:
        self.data, self.piece, self.now_s = data, piece, 0.0
        self.sent = bytearray()

    @property
    def in_waiting(self) -> int:
        return min(len(self.data), self.piece)

    def read(self, size: int) -> bytes:
        if not self.data:
            self.now_s += 0.01
        head, self.data = self.data[:size], self.data[size:]
        return head

    def write(self, data: bytes) -> int:
        self.sent += data
        return len(data)

    def close(self) -> None:
        pass


def lines_of(data: bytes, piece: int = 7) -> tuple[list[str], int]:
    wire = Wire(data, piece)
    link = Link(wire, "track", clock=lambda: wire.now_s)
    lines = list(iter(lambda: link.line(wire.now_s + 0.05), None))
    return lines, link.noise_bytes


def test_lines_come_whole_whatever_the_pieces() -> None:
    for piece in range(1, 12):
        assert lines_of(b"ok\r\nerror:9\r\n\r\n<x>\n", piece) == (["ok", "error:9", "<x>"], 0)


def test_noise_before_a_line_is_cut_and_within_spoils_it() -> None:
    assert lines_of(b"\xff\x00ok\n") == (["ok"], 2)
    spoilt = b"<Idle|MPos:1\xff.000,0,0>\n"
    assert lines_of(spoilt + b"ok\n") == (["ok"], len(spoilt))


def test_noise_without_an_end_does_not_pile_up() -> None:
    lines, noise = lines_of(b"\xaa" * (LONGEST_ANSWER + 1) + b"", 64)
    assert lines == []
    assert noise >= LONGEST_ANSWER


@examples(200)
@given(noise=st.binary(max_size=100).filter(lambda data: b"\n" not in data))
def test_a_line_after_noise_and_a_line_end_is_read(noise: bytes) -> None:
    lines, _ = lines_of(noise + b"\nok\n")
    assert lines[-1] == "ok"


def test_a_line_too_long_is_not_sent() -> None:
    wire = Wire(b"")
    link = Link(wire, "grbl track on here", clock=lambda: wire.now_s)
    link.send("X" * 69)
    assert len(wire.sent) == 70
    with pytest.raises(DeviceError, match=r"grbl track on here: .*71 characters.*allowed: 70"):
        link.send("Y" * 70)
    assert len(wire.sent) == 70
