"""The served live page in headless Chromium, beside a foreign page, which is another origin."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from chromium import Chromium
from fake_devices import LaserTrack
from live_rig import live_bench
from live_served import Page, served

from tests.validation.browser import wait_for

pytestmark = pytest.mark.xdist_group("live_page")  # one worker: one Chromium at a time
TOKEN = "correct-horse"
READY = "window.lscan?.framesDrawn > 0 && !document.querySelector('#start').disabled"


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    track = LaserTrack()
    with live_bench(monkeypatch, tmp_path / "runs", track) as bench, served(bench) as page:
        yield page


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder and says nothing."""

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the tests' output is theirs."""


@contextmanager
def foreign(folder: Path, html: str, name: str = "127.0.0.1") -> Iterator[str]:
    """The address of a page of somebody else's, on a port of its own, called by ``name``."""
    folder.mkdir(exist_ok=True)
    (folder / "index.html").write_text(html)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield f"http://{name}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_the_page_keeps_to_its_own_policy(chromium: Chromium, page: Page) -> None:
    tab = chromium.page
    chromium.take_errors()
    tab.goto(f"http://127.0.0.1:{page.port}/")
    wait_for(tab, READY)
    tab.click("#start")
    wait_for(tab, "document.querySelector('#scan-state').innerText === 'done'")
    assert chromium.take_errors() == []  # Chromium notes there what the policy forbade


@pytest.mark.slow  # that no page may frame it, test_server.py reads in the header
def test_a_foreign_page_that_frames_it_starts_nothing(
    chromium: Chromium, page: Page, tmp_path: Path
) -> None:
    """Clicks through a page laid under another, as the victim of clickjacking does."""
    tab = chromium.page
    own = f"http://127.0.0.1:{page.port}/"
    began_s = time.monotonic()
    tab.goto(own)
    wait_for(tab, READY)
    alive_s = time.monotonic() - began_s
    start = tab.evaluate(
        "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
        "(document.querySelector('#start').getBoundingClientRect())"
    )
    html = (
        f"<iframe src={own} style='position:fixed;left:0;top:0;width:100%;height:100%;border:0'"
        " onload='window.loaded = true'></iframe>"
    )
    for name in ("127.0.0.1", "localhost"):  # the same site by SameSite, and another one
        with foreign(tmp_path / name, html, name) as address:
            tab.goto(address)
            wait_for(tab, "window.loaded")
            until_s = time.monotonic() + 2 * alive_s
            while time.monotonic() < until_s:  # the framed page would have come to life meanwhile
                tab.mouse.click(*start)
                tab.evaluate("new Promise((go) => setTimeout(go, 50))")
            assert page.session.state()["scan"]["state"] == "idle"
    tab.goto("about:blank")
    assert any("frame-ancestors" in error for error in chromium.take_errors())


COMMANDS = {
    "scan/start": "{}",
    "laser": '{"on": true}',
    "move": '{"position_mm": 5}',
    "mode": '{"mode": "board"}',
    "board": "{}",
}
# A frame of a form counts twice: as it is made, and as it has its answer.
FORM = """<form method=post action={own}api/{command} enctype=text/plain target='{command}'>
<input name='{{"a":"' value='"}}'></form><iframe name='{command}'
 onload='window.answers = (window.answers ?? 0) + 1'></iframe><script>
for (const mode of ["no-cors", "cors"])
  for (const credentials of ["include", "omit"])
    fetch("{own}api/{command}", {{
      method: "POST", mode, credentials, body: JSON.stringify({body})
    }}).catch(() => 0).then(() => window.tried = (window.tried ?? 0) + 1);
[...document.forms].at(-1).submit();
</script>"""


@pytest.mark.parametrize("name", [pytest.param("127.0.0.1", marks=pytest.mark.slow), "localhost"])
def test_a_foreign_page_starts_nothing(
    chromium: Chromium, page: Page, tmp_path: Path, name: str
) -> None:
    tab = chromium.page
    own = f"http://127.0.0.1:{page.port}/"
    tab.goto(own)
    wait_for(tab, READY)  # with whatever cookie there is
    forms = [FORM.format(own=own, command=command, body=body) for command, body in COMMANDS.items()]
    with foreign(tmp_path / "evil", "\n".join(forms), name) as address:
        tab.goto(address)
        wait_for(tab, f"window.tried === {4 * len(forms)} && window.answers >= {2 * len(forms)}")
    state = page.session.state()
    assert (state["scan"]["state"], state["laser"], state["mode"]) == ("idle", None, "stripe")
    assert page.bench.drivers.track.trace == []  # type: ignore[attr-defined]
    tab.goto("about:blank")
    chromium.take_errors()


@contextmanager
def with_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    with (
        live_bench(monkeypatch, tmp_path / "runs") as bench,
        served(bench, token=TOKEN) as page,
    ):
        yield page


@pytest.mark.slow  # the cookies and the address, test_server.py and test_access.py have
def test_the_token_leaves_the_address_bar_and_the_history(
    chromium: Chromium, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tab = chromium.page
    with with_token(tmp_path, monkeypatch) as page, with_token(tmp_path / "b", monkeypatch) as two:
        for _ in range(2):  # the printed address serves the same browser again
            for one in (page, two):  # whose cookies are those of all ports
                tab.goto(f"http://127.0.0.1:{one.port}/?token={TOKEN}")
                wait_for(tab, READY)
                assert tab.evaluate("location.href") == f"http://127.0.0.1:{one.port}/"
                assert tab.evaluate("document.cookie") == ""
        history = tab.context.new_cdp_session(tab).send("Page.getNavigationHistory")
        assert [entry["url"] for entry in history["entries"] if TOKEN in entry["url"]] == []
        for one in (page, two):  # bare, as it stands in the address bar
            tab.goto(f"http://127.0.0.1:{one.port}/")
            wait_for(tab, READY)
        tab.goto("about:blank")
    chromium.take_errors()


@pytest.mark.slow  # that the token may come by a link, test_access.py shows
def test_a_link_with_the_token_on_another_site_opens_the_page(
    chromium: Chromium, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser that follows it withholds the cookie it was just given (SameSite=Strict)."""
    tab = chromium.page
    with with_token(tmp_path, monkeypatch) as page:
        own = f"http://127.0.0.1:{page.port}/"
        link = f"<a id=link href='{own}?token={TOKEN}'>the scanner</a>"
        with foreign(tmp_path / "mail", link, "localhost") as address:
            tab.goto(address)
            tab.click("#link")
            wait_for(tab, f"location.href === '{own}' && {READY}")
        tab.goto("about:blank")
    chromium.take_errors()
