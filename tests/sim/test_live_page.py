"""The live page in headless Chromium: real clicks and keys, real pixels, a mock of the server."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from live_mock import (
    CENTRE_PX,
    CLIPPED,
    GAP,
    HEIGHT,
    MARKS_PX,
    WIDTH,
    X_MM,
    Z_MM,
    Instrument,
    served,
)

from sim.hardware.browser import Browser, BrowserError, BrowserMissing, main

pytestmark = pytest.mark.xdist_group("live_page")  # one worker: they share a fixture

OUT = Path(__file__).resolve().parents[2] / "out" / "live"

# What marks the overlay in the picture: its colours are far from the red of the laser line.
# Each is [x, y] of the canvas's pixels with the colour, to within what blending leaves.
OVERLAY = """(() => {
  const {data, width, height} = document.querySelector("#picture").getContext("2d")
    .getImageData(0, 0, %d, %d);
  const found = [];
  for (let at = 0; at < data.length; at += 4) {
    const off = [%d, %d, %d].map((want, c) => Math.abs(data[at + c] - want));
    if (Math.max(...off) <= 3) found.push([(at / 4) %% width, Math.floor(at / 4 / width)]);
  }
  return found;
})()"""
DRAWING = "window.lscan?.framesDrawn > 2 && !document.querySelector('#go').disabled"
STRIPE, CLIPPED_COLOUR = (0, 220, 255), (255, 213, 0)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    try:
        browser = Browser()
    except BrowserMissing as missing:
        pytest.skip(str(missing))
    with browser:
        yield browser


@pytest.fixture
def instrument() -> Instrument:
    return Instrument()


@pytest.fixture
def page(chromium: Browser, instrument: Instrument) -> Iterator[Browser]:
    """The page of the instrument, drawing; at the end, nothing may stand in the console."""
    chromium.resize(1280, 800)
    chromium.prefer("light")
    with served(instrument) as url:
        chromium.open(url)
        chromium.wait_for(DRAWING)
        yield chromium
        assert chromium.take_errors() == []
        chromium.open("about:blank")
        chromium.take_errors()


def coloured(page: Browser, colour: tuple[int, int, int]) -> np.ndarray:
    """(N, 2) pixels (u, v) of the picture's canvas that have this colour."""
    found = page.evaluate(OVERLAY % (WIDTH, HEIGHT, *colour))
    return np.array(found, dtype=float).reshape(-1, 2)


def text(page: Browser, selector: str) -> str:
    return str(page.evaluate(f"document.querySelector('{selector}').innerText"))


def shows(page: Browser, selector: str, words: str) -> None:
    """Wait until the element's text holds the words."""
    page.wait_for(f"document.querySelector('{selector}').innerText.includes({words!r})")


def enabled(page: Browser, selector: str = "button") -> set[str]:
    """Names of the enabled buttons: their ids, or the way that they jog."""
    script = f"""[...document.querySelectorAll({selector!r})]
        .filter((one) => !one.disabled && !one.hidden)
        .map((one) => one.id || one.dataset.by)"""
    return set(page.evaluate(script))


def wait_for_post(instrument: Instrument, count: int) -> tuple[str, Any]:
    """The latest command once there are ``count``."""
    deadline = time.monotonic() + 30.0
    while len(instrument.posts) < count:
        assert time.monotonic() < deadline, instrument.posts
        time.sleep(0.02)
    assert len(instrument.posts) == count
    return instrument.posts[-1]


# ---- what is drawn ----------------------------------------------------------------------


def test_the_stripe_is_drawn_on_its_line_and_nowhere_else(page: Browser) -> None:
    # A dot is 2 px high about the centre: it covers one row fully, whose middle is within
    # 0.5 px of the centre, and two others in part.
    plain, clipped = coloured(page, STRIPE), coloured(page, CLIPPED_COLOUR)
    for pixels in (plain, clipped):
        columns = pixels[:, 0].astype(int)
        assert np.abs(pixels[:, 1] - CENTRE_PX[columns]).max() <= 1.0
    columns = np.arange(WIDTH)
    assert set(clipped[:, 0]) == set(columns[CLIPPED])
    assert set(plain[:, 0]) == set(columns) - set(columns[CLIPPED]) - set(columns[GAP])


def test_the_picture_under_the_stripe_is_the_cameras(page: Browser) -> None:
    # JPEG leaves the flat ground within a few DN of the 14 it was painted with.
    pixels = page.evaluate(
        "[...document.querySelector('#picture').getContext('2d')"
        f".getImageData(0, 0, {WIDTH}, 60).data]"
    )
    ground = np.array(pixels).reshape(60, WIDTH, 4)[..., :3]
    assert abs(ground.mean() - 14.0) < 1.0


def test_a_stripe_along_rows_is_drawn_across_them(page: Browser, instrument: Instrument) -> None:
    centre = [200.3] * HEIGHT
    stripe = {"axis": "rows", "centre_px": centre, "found": HEIGHT, "of": HEIGHT, "clipped": 0}
    instrument.frame = {"stripe": {**stripe, "width_px": 3.0, "snr": 20.0, "status": {}}}
    shows(page, "[data-number=found]", "rows, nearly all")
    pixels = coloured(page, STRIPE)
    assert set(pixels[:, 1]) == set(range(HEIGHT))
    assert np.abs(pixels[:, 0] - 200.3).max() <= 1.0


def test_the_profile_is_plotted_where_its_axes_say(page: Browser) -> None:
    for equal in (False, True):
        if equal:
            page.click("#equal")
        accent = page.evaluate(PLOTTED)
        plot = page.evaluate("window.lscan.plot")
        x, y = np.array(accent["pixels"], dtype=float).T + 0.5
        (x0, x1), (z0, z1) = plot["x"], plot["z"]
        x_mm = x0 + (x - plot["left"]) / (plot["right"] - plot["left"]) * (x1 - x0)
        z_mm = z0 + (plot["bottom"] - y) / (plot["bottom"] - plot["top"]) * (z1 - z0)
        per_px = (
            (x1 - x0) / (plot["right"] - plot["left"]),
            (z1 - z0) / (plot["bottom"] - plot["top"]),
        )
        seen = np.ones(WIDTH, dtype=bool)
        seen[GAP] = False
        distance = np.hypot(
            (x_mm[:, None] - X_MM[seen]) / per_px[0], (z_mm[:, None] - Z_MM[seen]) / per_px[1]
        ).min(axis=1)
        assert distance.max() <= 2.0  # a point is 2 px wide: its pixels lie within sqrt(2) of it
        assert x_mm.min() == pytest.approx(X_MM.min(), abs=2 * per_px[0])
        assert x_mm.max() == pytest.approx(X_MM.max(), abs=2 * per_px[0])
        inside = (x_mm > X_MM[GAP].min() + 2 * per_px[0]) & (x_mm < X_MM[GAP].max() - 2 * per_px[0])
        assert not inside.any()
        if equal:
            assert per_px[0] == pytest.approx(per_px[1], rel=1e-6)


# The pixels of the profile's canvas in the colour of its points; the axes have other colours.
PLOTTED = """(() => {
  const canvas = document.querySelector("#profile");
  const {data, width} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const pixels = [];
  for (let at = 0; at < data.length; at += 4)
    if (data[at] === 23 && data[at + 1] === 104 && data[at + 2] === 140 && data[at + 3] === 255)
      pixels.push([(at / 4) % width, Math.floor(at / 4 / width)]);
  return {pixels};
})()"""


def test_without_a_calibration_the_page_says_so(page: Browser, instrument: Instrument) -> None:
    instrument.state["calibration"] = None
    instrument.frame = {"profile": None}
    shows(page, "[data-number=sigma]", "take a board picture")
    shows(page, "#devices", "no calibration")
    assert page.evaluate("window.lscan.plot") is None
    drawn = page.evaluate("window.lscan.profilesDrawn")
    page.wait_for(f"window.lscan.framesDrawn > {drawn + 5}")
    assert page.evaluate("window.lscan.profilesDrawn") == drawn


@pytest.mark.parametrize(
    ("change", "number", "value", "grade", "verdict"),
    [
        ({"clipped": 0}, "saturation", "0.0 %", "good", "not clipped"),
        ({"clipped": 3}, "saturation", "0.5 %", "good", "a few columns clipped"),
        ({"clipped": 124}, "saturation", "20.0 %", "bad", "too bright: shorten the exposure"),
        ({"snr": 5.0}, "snr", "5", "bad", "lengthen the exposure"),
        ({"width_px": 1.4}, "width", "1.4 px", "fair", "very thin"),
        ({"width_px": 20.0}, "width", "20.0 px", "bad", "blurred"),
        ({"found": 0, "snr": None, "width_px": None}, "snr", "–", "", ""),
        ({"found": 200, "status": {"NO_PEAK": 440}}, "found", "200 of 640", "bad", "no peak 440"),
    ],
)
def test_each_number_has_its_verdict(
    page: Browser,
    instrument: Instrument,
    change: dict[str, Any],
    number: str,
    value: str,
    grade: str,
    verdict: str,
) -> None:
    stripe = {"axis": "columns", "centre_px": [], "found": 620, "of": 640, "clipped": 0}
    figures = {"width_px": 4.0, "snr": 40.0, "status": {}}
    instrument.frame = {"stripe": {**stripe, **figures, **change}}
    tile = f"[data-number={number}]"
    shows(page, f"{tile} .value", value)
    assert page.evaluate(f"document.querySelector('{tile}').dataset.grade") == grade
    assert verdict in text(page, f"{tile} .verdict")


@pytest.mark.parametrize(
    ("name", "frame", "key", "values", "grades"),
    [
        ("saturation", {"mode": "board"}, "saturated_percent", (0.5, 5), "good fair bad"),
        ("saturation", {"stripe": {"found": 1000}}, "clipped", (5, 50), "good fair bad"),
        ("snr", {"stripe": {}}, "snr", (8, 15), "bad fair good"),
        ("width", {"stripe": {}}, "width_px", (2, 8, 14), "fair good fair bad"),
        ("found", {"stripe": {"of": 100, "status": {}}}, "found", (50, 95), "bad fair good"),
        ("residual", {"board": {}}, "residual_rms_px", (0.2, 0.5), "good fair bad"),
        ("focus", {"focus_best": 100}, "focus", (80, 95), "bad fair good"),
    ],
)
def test_the_legend_names_each_limit_at_which_a_verdict_turns(
    page: Browser,
    name: str,
    frame: dict[str, Any],
    key: str,
    values: tuple[float, ...],
    grades: str,
) -> None:
    """Just below and just above each limit, the grades are those on either side of it."""
    inner = next((part for part in ("stripe", "board") if part in frame), None)

    def grade_and_legend(value: float) -> tuple[str, str]:
        told = {**frame, inner: {**frame[inner], key: value}} if inner else {**frame, key: value}
        script = f"""import("/live/figures.js").then(({{FIGURES}}) => {{
            const figure = FIGURES.find((one) => one.name === {name!r});
            return [figure.judge({json.dumps(told)})[0], figure.legend];
        }})"""
        grade, legend = page.evaluate(script)
        return grade, legend

    sides = grades.split()
    for limit, below, above in zip(values, sides[:-1], sides[1:], strict=True):
        assert grade_and_legend(0.999 * limit)[0] == below
        assert grade_and_legend(1.001 * limit)[0] == above
    legend = grade_and_legend(1.0)[1]
    told = [limit / 10 for limit in values] if key == "clipped" else values  # of 1000, in %
    assert [limit for limit in told if f" {limit:g} " not in legend.replace(",", " ")] == []
    assert legend in page.evaluate("document.querySelector('#legend').textContent")


def test_the_limits_of_the_board_and_of_the_rate_are_told(page: Browser) -> None:
    legend = page.evaluate("document.querySelector('#legend').textContent")
    for words in ("0.5 mm", "2 mm", "0.1°", "10 drawn", "under 3"):
        assert words in legend


def test_the_focus_bar_stands_against_the_best(page: Browser, instrument: Instrument) -> None:
    instrument.frame = {"focus": 30.0, "focus_best": 120.0}
    shows(page, "[data-number=focus]", "25 %")
    assert page.evaluate("document.querySelector('[data-number=focus] meter').value") == 0.25
    instrument.frame = {"focus": 120.0, "focus_best": 120.0}
    shows(page, "[data-number=focus]", "at its best")


# ---- board mode -------------------------------------------------------------------------


def test_the_board_is_shown_with_its_marks_and_where_it_stands(
    page: Browser, instrument: Instrument
) -> None:
    page.click("#mode-board")
    assert wait_for_post(instrument, 1) == ("/api/mode", {"mode": "board"})
    shows(page, "#board-advice", "Move the board 1.9 mm towards the camera")
    # The tilt about z is within twice its uncertainty: no word of it.
    assert text(page, "#board-advice").endswith("lean its top back by 0.4°.")
    corners = page.evaluate(
        "[...document.querySelectorAll('#corners g')]"
        ".map((one) => [one.dataset.side, one.textContent.trim()])"
    )
    values, sides = ["+1.4", "+0.6", "−0.3", "+4.4"], ["behind", "behind", "front", "behind"]
    assert corners == [list(pair) for pair in zip(sides, values, strict=True)]
    assert "20 of 20" in text(page, "[data-number=marks]")
    pixels = coloured(page, STRIPE)
    for u, v in MARKS_PX:  # an arm of a cross is 8 px long
        near = np.hypot(pixels[:, 0] - u, pixels[:, 1] - v) <= 9.0
        assert near.any()
        pixels = pixels[~near]
    assert len(pixels) == 0
    assert not page.evaluate("document.querySelector('#profile').checkVisibility()")


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        ({"distance_mm": -2.5}, "Move the board 2.5 mm away from the camera; lean its top back"),
        ({"distance_mm": 0.2, "tilt_x_deg": -0.6}, "Lean its top forward by 0.6°."),
        ({"distance_mm": 0.2, "tilt_x_deg": 0.0}, "The board stands in the sheet, within 0.6 mm"),
        ({"tilt_x_deg": 0.0, "tilt_z_deg": 1.0}, "; turn its right side forward by 1.0°."),
        (None, "Add camera_mm to [sheet]"),
    ],
)
def test_the_advice_undoes_the_offset(
    page: Browser, instrument: Instrument, offset: dict[str, float] | None, words: str
) -> None:
    instrument.state["mode"] = "board"
    shows(page, "#board-advice", "Move the board")
    board = instrument.next_frame(0)[0]["board"]  # type: ignore[index]
    board["offset"] = {**board["offset"], **offset} if offset else None
    board["offset_message"] = "" if offset else "Add camera_mm to [sheet] of the rig file."
    instrument.frame = {"board": board}
    shows(page, "#board-advice", words)


def test_a_board_that_is_not_found_says_why(page: Browser, instrument: Instrument) -> None:
    lost = {"found": 0, "expected": 20, "message": "no dots in the picture", "marks_px": []}
    residuals = dict.fromkeys(["residual_rms_px", "residual_max_px", "residual_rms_mm"])
    instrument.frame = {"board": {**lost, **residuals, "offset": None, "age_s": 0.1}}
    page.press("m")
    shows(page, "#board-advice", "no dots in the picture")
    assert "no board found" in text(page, "[data-number=marks]")


# ---- buttons and keys -------------------------------------------------------------------

JOGS = {"-10", "-1", "1", "10"}
FREE = {"start", "take-board", "laser", "go", *JOGS}
MODES = {"mode-stripe", "mode-board"}


@pytest.mark.parametrize(
    ("state", "done", "allowed"),
    [
        ("idle", 0, FREE),
        ("scanning", 34, {"pause", "stop"}),
        ("paused", 34, {"resume", "stop", "laser", "go", *JOGS}),
        ("stopping", 34, set()),
        ("done", 100, FREE),
        ("failed", 34, FREE | {"resume"}),
    ],
)
def test_only_what_can_be_done_can_be_clicked(
    page: Browser, instrument: Instrument, state: str, done: int, allowed: set[str]
) -> None:
    instrument.scan_is(state, done)
    words = {"idle": "ready", "stopping": "stopping after this frame"}.get(state, state)
    shows(page, "#scan-state", words)
    assert enabled(page) == allowed | MODES


def test_what_the_rig_lacks_cannot_be_clicked(page: Browser, instrument: Instrument) -> None:
    instrument.state.update(board=False, can_switch_laser=False)
    instrument.state["track"]["position_mm"] = None
    instrument.frame = {"position_mm": None}
    page.wait_for("document.querySelector('#laser').hidden")
    assert enabled(page) == {"start", "go", "mode-stripe"}


def test_clicks_send_their_commands(page: Browser, instrument: Instrument) -> None:
    page.click("#target")
    page.type("47.5")
    commands: list[tuple[str, str, Any]] = [
        ("#go", "/api/move", {"position_mm": 47.5}),
        (".jog[data-by='-10']", "/api/move", {"position_mm": 37.5}),
        (".jog[data-by='1']", "/api/move", {"position_mm": 38.5}),
        ("#laser", "/api/laser", {"on": False}),
        ("#laser", "/api/laser", {"on": True}),
        ("#start", "/api/scan/start", {}),
        ("#pause", "/api/scan/pause", {}),
        ("#resume", "/api/scan/resume", {}),
        ("#stop", "/api/scan/stop", {}),
        ("#take-board", "/api/board", {}),
    ]
    for count, (button, path, body) in enumerate(commands, start=1):
        page.wait_for(f'!document.querySelector("{button}").disabled')
        page.click(button)
        assert wait_for_post(instrument, count) == (path, body)
    shows(page, "#task", "board picture: taking picture 1 of 4")
    assert "take-board" not in enabled(page)


def test_quick_jogs_add_up(page: Browser, instrument: Instrument) -> None:
    for _ in range(3):
        page.click(".jog[data-by='1']")
    wait_for_post(instrument, 3)
    assert [body["position_mm"] for _, body in instrument.posts] == [13.0, 14.0, 15.0]


def test_a_disabled_button_does_not_answer(page: Browser, instrument: Instrument) -> None:
    page.click("#pause")
    page.press("p")
    page.press("Escape")
    page.press("b")
    assert wait_for_post(instrument, 1) == ("/api/board", {})


def test_a_whole_scan_by_the_keyboard(page: Browser, instrument: Instrument) -> None:
    page.evaluate("document.activeElement.blur()")
    for _ in range(30):
        if page.evaluate("document.activeElement.id") == "name":
            break
        page.press("Tab")
    page.type("bps")  # typed into the name, these are no shortcuts
    assert page.evaluate("document.querySelector('#name').value") == "bps"
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.press("Tab")
    assert page.evaluate("document.activeElement.id") == "start"
    page.press("Enter")
    assert wait_for_post(instrument, 1) == ("/api/scan/start", {"name": "bps"})
    page.wait_for("document.activeElement.id === 'pause'")  # the next thing to press
    page.press(" ")
    assert wait_for_post(instrument, 2)[0] == "/api/scan/pause"
    page.wait_for("document.activeElement.id === 'resume'")
    for count, (key, path) in enumerate(
        [("p", "resume"), ("p", "pause"), ("p", "resume"), ("Escape", "stop")], start=3
    ):
        page.press(key)
        assert wait_for_post(instrument, count)[0] == f"/api/scan/{path}"
        page.evaluate("new Promise((go) => setTimeout(go, 50))")
    shows(page, "#scan-note", "35 of 100 frames")
    shows(page, "#scan-state", "stopped")
    assert "resume" in enabled(page)


def test_every_control_is_reached_by_tab(page: Browser) -> None:
    page.evaluate("document.activeElement.blur()")
    reached = []
    for _ in range(30):
        page.press("Tab")
        name = page.evaluate(
            "(({id, dataset, tagName}) => id || dataset.by || tagName)(document.activeElement)"
        )
        if name in reached:
            break
        reached.append(name)
    assert enabled(page) | {"equal", "name", "target", "SUMMARY"} <= set(reached)


# ---- progress and faults ----------------------------------------------------------------


def test_the_progress_of_a_scan_is_told(page: Browser, instrument: Instrument) -> None:
    instrument.scan_is("scanning", 34)
    shows(page, "#scan-note", "34 of 100 frames · 0:16 left · 0:08 gone · runs/scan-003")
    assert page.evaluate("document.querySelector('#progress').value") == 0.34
    assert page.evaluate("document.title").startswith("34 %")


def test_faults_stand_in_the_alert_line_until_they_are_gone(
    page: Browser, instrument: Instrument
) -> None:
    assert page.evaluate("document.querySelector('#alert').checkVisibility()") is False
    instrument.refusal = "a scan is going on"
    page.click("#start")
    shows(page, "#alert", "a scan is going on")
    page.take_errors()  # the browser notes every refused request in its console
    instrument.state["camera"]["error"] = "no picture for 2.0 s"
    shows(page, "#alert", "Camera: no picture for 2.0 s")
    instrument.scan_is("failed", 34, message="the disk is full")
    shows(page, "#alert", "Scan: the disk is full")
    instrument.refusal = ""
    instrument.state["camera"]["error"] = ""
    page.click("#resume")
    page.wait_for("document.querySelector('#alert').innerText === ''")


def test_a_server_that_went_away_is_waited_for(chromium: Browser) -> None:
    first = Instrument()
    with served(first) as url:
        chromium.open(url)
        chromium.wait_for("window.lscan?.framesDrawn > 20")
    chromium.wait_for("document.querySelector('#connection').innerText === 'no connection'")
    assert "trying again" in text(chromium, "#alert")
    drawn = chromium.evaluate("window.lscan.framesDrawn")
    with served(Instrument(), urlsplit(url).port or 0):  # its numbers begin at 1 again
        chromium.wait_for(f"window.lscan.framesDrawn > {drawn + 3}")
        chromium.wait_for("document.querySelector('#connection').innerText === 'live'")
        assert text(chromium, "#alert") == ""
        errors = chromium.take_errors()
        assert errors, "the lost server stands in the console"
        assert all(error.startswith("network:") for error in errors)
        chromium.open("about:blank")
    chromium.take_errors()


def test_a_token_is_asked_for_and_kept(chromium: Browser) -> None:
    instrument = Instrument()
    instrument.token = "one-two-three"
    with served(instrument) as url:
        chromium.open(url)
        assert "Open the address with its token" in chromium.evaluate("document.body.innerText")
        chromium.open(f"{url}?token=one-two-three")
        chromium.wait_for(DRAWING)
        chromium.click("#start")
        assert wait_for_post(instrument, 1)[0] == "/api/scan/start"
        instrument.token = "another"  # the server was started anew
        shows(chromium, "#alert", "Open the address with its token")
        shows(chromium, "#connection", "refused")
        chromium.open("about:blank")
    chromium.take_errors()


def test_a_hidden_page_asks_for_no_pictures(page: Browser) -> None:
    page.evaluate(
        "Object.defineProperty(document, 'hidden', {get: () => window.covered, configurable: true})"
    )
    page.evaluate("window.covered = true")
    page.wait_for("(window.lscan.seen ??= window.lscan.framesDrawn) && true")
    page.evaluate("new Promise((go) => setTimeout(go, 300))")  # the picture on its way
    drawn = page.evaluate("window.lscan.framesDrawn")
    page.evaluate("new Promise((go) => setTimeout(go, 500))")
    assert page.evaluate("window.lscan.framesDrawn") == drawn
    page.evaluate("window.covered = false; document.dispatchEvent(new Event('visibilitychange'))")
    page.wait_for(f"window.lscan.framesDrawn > {drawn}")


# ---- on a phone, and pictures to look at ------------------------------------------------


@pytest.mark.parametrize("mode", ["stripe", "board"])
def test_a_phone_shows_one_column_with_room_for_fingers(
    page: Browser, instrument: Instrument, mode: str
) -> None:
    instrument.state["mode"] = mode
    instrument.scan_is("scanning")
    instrument.state["scan"]["folder"] = "runs/" + "a-long-name-" * 6
    page.resize(360, 740, mobile=True)
    page.wait_for(f"document.body.dataset.mode === '{mode}'")
    shows(page, "#scan-state", "scanning")
    page.click("summary")
    assert page.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [360, 360]
    beyond = page.evaluate(
        "[...document.querySelectorAll('body *')].filter((one) => one.checkVisibility() "
        "&& !one.closest('.unseen') && one.getBoundingClientRect().right > 360.5)"
        ".map((one) => one.outerHTML.slice(0, 80))"
    )
    assert beyond == []
    small = page.evaluate(
        "[...document.querySelectorAll('button, input:not([type=checkbox]), label.check, summary')]"
        ".filter((one) => one.checkVisibility())"
        ".map((one) => [one.id || one.textContent.trim(), one.getBoundingClientRect()])"
        ".filter(([, box]) => box.height < 44 || box.width < 44).map(([name]) => name)"
    )
    assert small == []


IN_REACH = """(() => [...document.querySelectorAll(".scan button")]
  .filter((one) => one.checkVisibility())
  .map((one) => [one, one.getBoundingClientRect()])
  .filter(([one, box]) => box.top >= 0 && box.bottom <= innerHeight && box.height >= 44
    && box.width >= 44
    && one === document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2))
  .map(([one]) => one.id))()"""


@pytest.mark.parametrize("size", [(360, 740), (740, 360)])
def test_a_phone_keeps_the_buttons_of_a_scan_within_reach(
    page: Browser, instrument: Instrument, size: tuple[int, int]
) -> None:
    page.resize(*size, mobile=True)
    page.evaluate("scrollTo(0, 0)")
    assert page.evaluate(IN_REACH) == []  # no scan, no bar: the picture has the room
    states = [("scanning", ["pause", "stop"]), ("paused", ["resume", "stop"])]
    for state, buttons in states:
        instrument.scan_is(state)
        shows(page, "#scan-state", state)
        for scroll_px in (0, 300, 10_000):
            page.evaluate(f"scrollTo(0, {scroll_px})")
            assert page.evaluate(IN_REACH) == buttons
    # Scrolled to its end, the page ends above the bar, which hides nothing.
    bar, end = page.evaluate(
        "['.scan .buttons', 'main'].map((one) => document.querySelector(one)"
        ".getBoundingClientRect()).map((box) => [box.top, box.bottom])"
    )
    assert end[1] <= bar[0]
    page.evaluate("scrollTo(0, 0)")
    page.click("#stop")
    assert wait_for_post(instrument, 1) == ("/api/scan/stop", {})
    page.evaluate("scrollTo(0, 0)")
    page.wait_for(f"{IN_REACH}.length === 0")


def test_what_is_reached_by_tab_is_not_under_the_bar(page: Browser, instrument: Instrument) -> None:
    page.resize(360, 740, mobile=True)
    instrument.scan_is("paused")
    shows(page, "#scan-state", "paused")
    page.evaluate("document.activeElement.blur()")
    reached = set()
    for _ in range(20):
        page.press("Tab")
        name, covered = page.evaluate(
            "(() => { const one = document.activeElement, box = one.getBoundingClientRect();"
            "const bar = document.querySelector('.scan .buttons');"
            "return [one.id || one.dataset.by || one.tagName,"
            "one !== document.body && !bar.contains(one)"
            " && box.bottom > bar.getBoundingClientRect().top]; })()"
        )
        if name in reached:
            break
        assert not covered, name
        reached.add(name)
    assert {"10", "target", "resume", "stop"} <= reached


@pytest.mark.slow
def test_screenshots_are_kept(page: Browser, instrument: Instrument) -> None:
    for name in ("stripe", "board", "scanning"):
        mode = "board" if name == "board" else "stripe"
        instrument.state["mode"] = mode
        instrument.scan_is("scanning" if name == "scanning" else "idle")
        page.wait_for(f"document.body.dataset.mode === '{mode}'")
        for device, (width, height) in {"desktop": (1280, 800), "phone": (360, 740)}.items():
            page.resize(width, height, mobile=device == "phone")
            drawn = page.evaluate("window.lscan.framesDrawn")
            page.wait_for(f"window.lscan.framesDrawn > {drawn + 8}")
            path = OUT / f"{device}-{name}.png"
            page.screenshot(path, whole=device == "phone")
            assert path.stat().st_size > 10_000
    page.prefer("dark")
    page.resize(1280, 800)
    page.evaluate("new Promise((go) => setTimeout(go, 200))")
    page.screenshot(OUT / "desktop-dark.png")


# ---- the browser itself -----------------------------------------------------------------


def test_what_is_covered_or_missing_cannot_be_clicked(chromium: Browser) -> None:
    chromium.open(
        "data:text/html,<button id=a>a</button>"
        "<div style='position:fixed;inset:0' onclick='window.hit = 1'></div>"
    )
    with pytest.raises(BrowserError, match="something covers it"):
        chromium.click("#a")
    with pytest.raises(BrowserError, match="no such element"):
        chromium.click("#b")
    with pytest.raises(BrowserError, match=r"not true within 0\.1 s: 1 > 2"):
        chromium.wait_for("1 > 2", timeout_s=0.1)


def test_errors_of_a_page_are_told_once(chromium: Browser) -> None:
    chromium.take_errors()
    chromium.open("data:text/html,<script>console.error('a', 1); lost.x</script>")
    assert chromium.take_errors() == [
        "console: a 1",
        "exception: ReferenceError: lost is not defined",
    ]
    assert chromium.take_errors() == []
    with pytest.raises(BrowserError, match="does not load"):
        chromium.open("http://127.0.0.1:9/")
    chromium.open("about:blank")
    chromium.take_errors()


def test_without_chromium_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LSCAN_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(BrowserMissing, match="install the Debian package chromium"):
        Browser()
    monkeypatch.setenv("LSCAN_CHROMIUM", "no-such-browser")
    with pytest.raises(BrowserMissing, match=r"LSCAN_CHROMIUM: .*'no-such-browser'"):
        Browser()


def test_where_it_cannot_be_installed_the_tests_go_on_without(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("LSCAN_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", "")
    assert main([]) == 2
    assert "install the Debian package chromium" in capsys.readouterr().err
    assert main(["--install"]) == 0
    assert "there is no apt-get here" in capsys.readouterr().err


def test_a_browser_that_does_not_start_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "chromium"
    script = '[ "$1" = --version ] && echo Chromium 1 && exit; echo no display >&2; exit 1'
    broken.write_text(f"#!/bin/sh\n{script}\n")
    broken.chmod(0o755)
    kept = tmp_path / "profiles"
    kept.mkdir()
    monkeypatch.setenv("LSCAN_CHROMIUM", str(broken))
    monkeypatch.setattr("tempfile.tempdir", str(kept))
    with pytest.raises(BrowserError, match=r"does not start \(no display\)"):
        Browser()
    assert list(kept.iterdir()) == []
