#!/usr/bin/env bash
# grbl-streamer 2.0.2 (PyPI), a "universal interface module for the grbl CNC firmware", run here
# with pyserial 3.5, hears only part of what the controllers of today say.
#
# Seen, with lines that Grbl 1.1h, Grbl 0.9j and grblHAL 1.1f (2026) send:
#   - The banner of grblHAL as built by default, "GrblHAL 1.1f ['$' or '$HELP' for help]", is no
#     start: on_boot does not come and `connected` stays False.  Grbl 1.1h's is one.
#   - The settings of Grbl 1.1, "$1=255", are not read: only those of 0.9, "$1=255 (step idle
#     delay, msec)", which 1.1 sends without their comments.
#   - The answer to $G of Grbl 1.1, "[GC:G0 G54 ... F0 S0]", does not lead to
#     on_gcode_parser_stateupdate: that of 0.9, "[G0 G54 ... M0 M5 M9 T0 F0. S0.]", does.
#   - Status reports of both are read.
# Exits with an error where one of these is no longer so.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    grbl-streamer==2.0.2 gcode-machine==1.0.3 pyserial==3.5

"$folder/venv/bin/python" - <<'PYTHON'
import os
import sys
import time
import traceback
import tty

from grbl_streamer import GrblStreamer

def fail(*error):
    """End at once, as below."""
    traceback.print_exception(*error)
    os._exit(1)


sys.excepthook = fail

GRBL_11 = "[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]"
GRBL_09 = "[G0 G54 G17 G21 G90 G94 M0 M5 M9 T0 F0. S0.]"
GRBLHAL = "GrblHAL 1.1f ['$' or '$HELP' for help]"


def heard(*lines):
    """The events, and the streamer, after a controller has said these lines and "end"."""
    controller, port = os.openpty()
    tty.setraw(port)
    events = []
    streamer = GrblStreamer(lambda event, *data: events.append((event, data)))
    streamer.cnect(os.ttyname(port), 115200)
    events.clear()
    for line in lines:
        os.write(controller, f"{line}\r\n".encode())
    deadline = time.monotonic() + 30
    while ("on_read", ("end",)) not in events and time.monotonic() < deadline:
        time.sleep(0.3)  # a start drops what waits to be read, so the end is said again
        os.write(controller, b"end\r\n")
    assert ("on_read", ("end",)) in events, f"the streamer did not read: {events}"
    return [event for event, _ in events], streamer


events, streamer = heard("Grbl 1.1h ['$' for help]")
print("Grbl 1.1h's banner: on_boot", "on_boot" in events, "connected", streamer.connected)
assert "on_boot" in events and streamer.connected
events, streamer = heard(GRBLHAL)
print("grblHAL's banner:   on_boot", "on_boot" in events, "connected", streamer.connected)
assert "on_boot" not in events and not streamer.connected

_, streamer = heard("$1=255")
print("$1 of Grbl 1.1:", streamer.settings.get(1))
assert 1 not in streamer.settings
_, streamer = heard("$1=255 (step idle delay, msec)")
print("$1 of Grbl 0.9:", streamer.settings.get(1))
assert streamer.settings[1]["val"] == "255"

for name, answer, is_read in (("1.1", GRBL_11, False), ("0.9", GRBL_09, True)):
    events, _ = heard(answer)
    print(f"$G of Grbl {name}: state update", "on_gcode_parser_stateupdate" in events)
    assert ("on_gcode_parser_stateupdate" in events) is is_read

events, _ = heard("<Idle|MPos:0.500,0.000,0.000|FS:0,0>")
assert "on_stateupdate" in events
sys.stdout.flush()
os._exit(0)  # the streamer's threads would go on
PYTHON
