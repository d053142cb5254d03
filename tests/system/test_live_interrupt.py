"""The end of ``lscan live`` on the tank's own drivers: Mitsuba handles SIGINT too as it renders."""

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from places import ROOT

# Direct light, whose first picture comes soon, and so many samples that it renders all the time.
SCENE = 'include = "paper/sandwave"\n[render]\nscatter_samples = 0\nsamples = 64\n'
LONG_S = 120.0  # longer than it takes to render and to end; only a failure waits so long


@pytest.mark.slow
@pytest.mark.parametrize("at_first", ["trap - INT", "trap '' INT"])
def test_an_interrupt_ends_it_while_mitsuba_renders(tmp_path: Path, at_first: str) -> None:
    """Begun as in a terminal, and with SIGINT ignored, as a script begins a job with "&"."""
    shell = ["sh", "-c", f'{at_first}; exec "$@"', "sh"]
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    options = ["--port", "0", "-o", str(tmp_path / "runs")]
    command = [*shell, sys.executable, "-m", "lscan.cli.app", "live", str(scene), *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[0]
            answer = f"{address}api/frame?after=0"
            while urllib.request.urlopen(answer, timeout=LONG_S).status != 200:
                assert process.poll() is None
            process.send_signal(signal.SIGINT)
            assert process.wait(LONG_S) == 0
        finally:
            process.kill()
