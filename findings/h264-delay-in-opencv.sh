#!/usr/bin/env bash
# OpenCV's VideoCapture hands out a live H.264 stream several pictures late, and nothing says so.
#
# Pictures are given one by one to an x264 encoder (PyAV); what it has put out by then is sent over
# HTTP (MPEG-TS) and the connection is held open, as by a camera whose next picture is still to
# come.  Counted is how many can be read from cv2.VideoCapture without waiting for more.
#
# Seen with opencv-python-headless 4.12.0.88, av 15.1.0, NumPy 2.2.6 (Linux, Python 3.11), one thread
# in encoder and decoder, of 250 pictures given:
#   zerolatency (no B-frames, no look-ahead):  250 packets sent, 248 read: 2 late
#   three B-frames, no look-ahead:             246 packets sent, 242 read: 8 late
# The back end's properties tell neither the reordering nor the age: CAP_PROP_POS_MSEC begins at 0
# with the first picture that is read, whenever it was exposed.  Whoever moves something and takes
# "the next picture" gets one exposed before the move.
#
# Exits non-zero where this changes.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet opencv-python-headless==4.12.0.88 av==15.1.0 numpy==2.2.6

# Each in a process of its own: both packages carry an FFmpeg.
cat > "$folder/encode.py" <<'PYTHON'
import io
import sys
from pathlib import Path

import av
import numpy as np

GIVEN, (WIDTH, HEIGHT) = 250, (160, 120)  # ten seconds: FFmpeg looks at five before it begins
CODED = {
    "zerolatency": {"tune": "zerolatency", "preset": "ultrafast"},
    "b-frames": {
        "preset": "veryfast", "bf": "3", "b_strategy": "0", "rc-lookahead": "0", "sc_threshold": "0"
    },
}
for name, options in CODED.items():
    out, packets = io.BytesIO(), 0
    container = av.open(out, "w", format="mpegts", options={"flush_packets": "1"})
    stream = container.add_stream("libx264", rate=25)
    stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    stream.options = {"threads": "1", **options}
    generator = np.random.default_rng(1)
    for _ in range(GIVEN):
        image = generator.integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")):
            container.mux(packet)
            packets += 1
    Path(sys.argv[1], f"{name}.ts").write_bytes(out.getvalue())
    container.close()
    print(f"{name}: given {GIVEN}, packets sent {packets}", flush=True)
PYTHON
cat > "$folder/read.py" <<'PYTHON'
import os
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2

GIVEN = 250


class Camera(BaseHTTPRequestHandler):
    """Sends what there is, and then nothing."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "video/mp2t")
        self.end_headers()
        self.wfile.write(Path(sys.argv[1], self.path.strip("/")).read_bytes())
        time.sleep(60)

    def log_message(self, *_):
        pass


server = ThreadingHTTPServer(("127.0.0.1", 0), Camera)
server.daemon_threads = True
threading.Thread(target=server.serve_forever, daemon=True).start()
late = {}
for name in ("zerolatency", "b-frames"):
    url = f"http://127.0.0.1:{server.server_address[1]}/{name}.ts"
    settings = [cv2.CAP_PROP_READ_TIMEOUT_MSEC, 4000, cv2.CAP_PROP_N_THREADS, 1]
    capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, settings)
    read, stamps_ms = 0, []
    while True:
        asked_s = time.monotonic()
        ok, _ = capture.read()
        if not ok or time.monotonic() - asked_s > 2:  # after the timeout, what is left is flushed
            break
        read += 1
        stamps_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    late[name] = GIVEN - read
    print(f"{name}: read {read}, {late[name]} late; first POS_MSEC {stamps_ms[0]:g}", flush=True)
    if abs(stamps_ms[0]) > 1:
        sys.exit("the stamps do not begin at 0")
if late["zerolatency"] > 2 or late["b-frames"] < late["zerolatency"] + 3:
    sys.exit(f"not as described: {late}")
print("as described", flush=True)
os._exit(0)  # a thread of the server still sleeps
PYTHON
"$folder/venv/bin/python" "$folder/encode.py" "$folder"
"$folder/venv/bin/python" "$folder/read.py" "$folder" 2> "$folder/errors" || { cat "$folder/errors"; exit 1; }
