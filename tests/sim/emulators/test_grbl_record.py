"""The emulated controllers against what real firmware answered: docs/reference/drivers.md."""

import re

import pytest
from grbl_line import GRBLHAL, GRBLHAL_AS_GRBL, SimulatedTime
from places import ROOT

from sim.emulators.grbl import GRBL, GrblEmulator, MarlinEmulator

MACHINE = {20: 0, 22: 0, 110: 500, 120: 10}  # of the simulators, which is slow enough to be met
COLUMNS = {"Grbl 1.1h": GRBL, "grblHAL, level 0": GRBLHAL, "grblHAL, level 1": GRBLHAL_AS_GRBL}
REQUESTS = {"Ctrl-X": b"\x18", "0x85": b"\x85"}
WAITS_S = {"*at rest*": 60.0, "*in motion*": 1.0}


def table(head: str) -> list[list[str]]:
    """The rows beneath this head, each a list of cells, "same" resolved."""
    page = (ROOT / "docs" / "reference" / "drivers.md").read_text()
    _, begun, rest = page.partition(head)
    assert begun, "the page has no such table"
    rows = []
    for line in rest.partition("\n\n")[0].splitlines()[2:]:
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        rows.append([cells[1] if cell == "same" else cell for cell in cells])
    assert rows
    return rows


def said(cell: str) -> list[str]:
    """The lines of a cell; none of "nothing"."""
    return [line.replace(r"\|", "|") for line in re.findall("`([^`]*)`", cell)]


def fits(line: str, recorded: str) -> bool:
    """Whether a line is as recorded: of a report the state, MPos and FS; "…" is anything."""
    if line.startswith("<"):
        parts = line.strip("<>").split("|")
        line = f"<{'|'.join(p for p in parts if p[:4] in ('MPos', 'FS:0') or p == parts[0])}>"
    return re.fullmatch(".*".join(map(re.escape, recorded.split("…"))), line) is not None


def check(emulator: GrblEmulator | MarlinEmulator, head: str, column: int = 0) -> None:
    """Make the requests of a table's rows; each answer is as recorded in its column."""
    for request, *cells in table(head):
        if request in WAITS_S:
            emulator._clock.sleep(WAITS_S[request])
            continue
        if request.startswith("`") or request in REQUESTS:
            line = request.strip("`")
            text = line.encode() if len(line) == 1 else f"{line}\n".encode()
            emulator.receive(REQUESTS.get(line, text))
        heard = [line for line in emulator.transmit().decode().splitlines() if line]
        recorded = said(cells[column])
        assert len(heard) == len(recorded), (request, heard, recorded)
        for line, told in zip(heard, recorded, strict=True):
            assert fits(line, told), (request, line, told)


@pytest.mark.parametrize("name", COLUMNS)
def test_an_emulated_grbl_answers_as_the_firmware_did(name: str) -> None:
    emulator = GrblEmulator(MACHINE, clock=SimulatedTime(), firmware=COLUMNS[name])
    check(emulator, "| request | Grbl 1.1h | grblHAL, level 0 |", list(COLUMNS).index(name))


def test_an_emulated_grbl_in_alarm_answers_as_the_firmware_did() -> None:
    emulator = GrblEmulator(clock=SimulatedTime())
    emulator.receive(b"$X\nF523456\nG1M3S1000\n")
    emulator.transmit()
    emulator.receive(b"G1X500F100\n")
    check(emulator, "| request | Grbl 1.1h, `$20=1`")
    assert emulator.laser_power == 0


def test_an_emulated_marlin_answers_as_the_firmware_did() -> None:
    emulator = MarlinEmulator(clock=SimulatedTime())
    emulator.transmit()
    check(emulator, "| request | answer |")
