"""The live page in headless Chromium: real clicks and keys, real pixels, a mock of the server.

A page takes a second, so what is not marked slow is what would mislead or endanger: the stripe and
the profile where they are, the verdicts, what can be clicked and what it sends, and every fault.
"""

import itertools
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from chromium import Chromium
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
    board_answer,
    served,
)
from places import ROOT
from playwright.sync_api import Page

from tests.validation.browser import wait_for

pytestmark = pytest.mark.xdist_group("live_page")  # one worker: they share a fixture

GUIDE = ROOT / "docs" / "howto" / "use-the-live-page.md"

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
ALIGNING = {"phase": "alignment"}
STRIPE, CLIPPED_COLOUR = (0, 220, 255), (255, 213, 0)


@pytest.fixture
def instrument() -> Instrument:
    return Instrument()


@contextmanager
def drawing(chromium: Chromium, page: Page, instrument: Instrument) -> Iterator[Page]:
    """The instrument's live page in ``page``; at the end, nothing may stand in the console."""
    with served(instrument) as url:
        page.goto(url)
        wait_for(page, DRAWING)
        yield page
        assert chromium.take_errors() == []
        page.goto("about:blank")
        chromium.take_errors()


@pytest.fixture
def page(chromium: Chromium, instrument: Instrument) -> Iterator[Page]:
    resize(chromium.page, 1280, 800)
    chromium.page.emulate_media(color_scheme="light")
    with drawing(chromium, chromium.page, instrument) as page:
        yield page


@pytest.fixture
def phone(chromium: Chromium, instrument: Instrument) -> Iterator[Page]:
    with chromium.phone() as phone, drawing(chromium, phone, instrument):
        yield phone


def resize(page: Page, width: int, height: int) -> None:
    page.set_viewport_size({"width": width, "height": height})


def coloured(page: Page, colour: tuple[int, int, int]) -> np.ndarray:
    """(N, 2) pixels (u, v) of the picture's canvas that have this colour."""
    found = page.evaluate(OVERLAY % (WIDTH, HEIGHT, *colour))
    return np.array(found, dtype=float).reshape(-1, 2)


def text(page: Page, selector: str) -> str:
    return str(page.evaluate(f"document.querySelector('{selector}').innerText"))


def shows(page: Page, selector: str, words: str) -> None:
    """Wait until the element's text holds the words."""
    wait_for(page, f"document.querySelector('{selector}').innerText.includes({words!r})")


def enabled(page: Page, selector: str = "button") -> set[str]:
    """Names of the enabled buttons: their ids, or the way that they jog."""
    script = f"""[...document.querySelectorAll({selector!r})]
        .filter((one) => !one.disabled && !one.hidden)
        .map((one) => one.id || one.dataset.by)"""
    return set(page.evaluate(script))


def wait_for_state_asked(instrument: Instrument) -> None:
    """Return when the page has asked for the state once more, having shown the last answer."""
    asked, deadline = instrument.states_asked, time.monotonic() + 120.0
    while instrument.states_asked == asked:
        assert time.monotonic() < deadline, asked
        time.sleep(0.02)


def wait_for_post(instrument: Instrument, count: int) -> tuple[str, Any]:
    """The latest command once there are ``count``."""
    deadline = time.monotonic() + 120.0
    while len(instrument.posts) < count:
        assert time.monotonic() < deadline, instrument.posts
        time.sleep(0.02)
    assert len(instrument.posts) == count
    return instrument.posts[-1]


# ---- what is drawn ----------------------------------------------------------------------


def test_the_stripe_is_drawn_on_its_line_and_nowhere_else(page: Page) -> None:
    # A dot is 2 px high about the centre: it covers one row fully, whose middle is within
    # 0.5 px of the centre, and two others in part.
    plain, clipped = coloured(page, STRIPE), coloured(page, CLIPPED_COLOUR)
    for pixels in (plain, clipped):
        columns = pixels[:, 0].astype(int)
        assert np.abs(pixels[:, 1] - CENTRE_PX[columns]).max() <= 1.0
    columns = np.arange(WIDTH)
    assert set(clipped[:, 0]) == set(columns[CLIPPED])
    assert set(plain[:, 0]) == set(columns) - set(columns[CLIPPED]) - set(columns[GAP])


@pytest.mark.slow
def test_the_picture_under_the_stripe_is_the_cameras(page: Page) -> None:
    # JPEG leaves the flat ground within a few DN of the 14 it was painted with.
    mean = page.evaluate(
        "(() => { const {data} = document.querySelector('#picture').getContext('2d')"
        f".getImageData(0, 0, {WIDTH}, 60);"
        "return data.reduce((sum, dn, at) => at % 4 === 3 ? sum : sum + dn, 0)"
        " / (0.75 * data.length); })()"  # the fourth of each pixel is its opacity
    )
    assert abs(mean - 14.0) < 1.0


@pytest.mark.slow
def test_a_stripe_along_rows_is_drawn_across_them(page: Page, instrument: Instrument) -> None:
    centre = [200.3] * HEIGHT
    stripe = {"axis": "rows", "centre_px": centre, "found": HEIGHT, "of": HEIGHT, "clipped": 0}
    instrument.frame = {"stripe": {**stripe, "width_px": 3.0, "snr": 20.0, "status": {}}}
    shows(page, "[data-number=found]", "rows, nearly all")
    pixels = coloured(page, STRIPE)
    assert set(pixels[:, 1]) == set(range(HEIGHT))
    assert np.abs(pixels[:, 0] - 200.3).max() <= 1.0


def test_the_profile_is_plotted_where_its_axes_say(page: Page) -> None:
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


# The rectangles of all that is written on the profile's canvas, with the words.
WRITTEN = """(() => {
  const context = document.querySelector("#profile").getContext("2d"), written = [];
  const write = context.fillText;
  context.fillText = (text, x, y) => {
    const box = context.measureText(text);
    written.push([text, x - box.actualBoundingBoxLeft, x + box.actualBoundingBoxRight,
               y - box.actualBoundingBoxAscent, y + box.actualBoundingBoxDescent]);
    write.call(context, text, x, y);
  };
  document.querySelector("#equal").dispatchEvent(new Event("change"));
  delete context.fillText;
  return written;
})()"""


@pytest.mark.slow
def test_nothing_on_the_profile_is_written_over_another(page: Page, instrument: Instrument) -> None:
    """Also with the highest tick at the upper edge, -20, 0, 20 and 1000 mm there."""
    sizes = ((1280, 800), (390, 844), (844, 390))
    heights_mm = (-24.0, -4.0, 10.0, 16.0, 996.0)
    for count, (highest_mm, size) in enumerate(itertools.product(heights_mm, sizes), start=1):
        z_mm = (Z_MM - Z_MM.max() + highest_mm).tolist()
        resize(page, *size)
        profile = {"x_mm": X_MM.tolist(), "z_mm": z_mm, "sigma_mm": 0.1 + 0.01 * count}
        instrument.frame = {"profile": profile}
        shows(page, "[data-number=sigma]", f"{0.1 + 0.01 * count:.2f}")  # with its profile
        written = page.evaluate(WRITTEN)
        assert {"x in mm", "z in mm"} < {words for words, *_ in written}
        for one, (words, left, right, top, bottom) in enumerate(written):
            for other, other_left, other_right, other_top, other_bottom in written[:one]:
                beside = right <= other_left or other_right <= left
                assert beside or bottom <= other_top or other_bottom <= top, (words, other)


@pytest.mark.slow
def test_the_zoom_magnifies_the_stripe_where_it_is_clicked(page: Page) -> None:
    """Four times: the window is a quarter of the picture, about the stripe at that place."""
    for column in (320, 128, 512):
        click_on_picture(page, column / WIDTH)
        page.click("#zoom")
        after_pictures(page, 1)
        pixels = np.vstack([coloured(page, STRIPE), coloured(page, CLIPPED_COLOUR)])
        # Of a dot four pixels wide the middle is 1.5; the mouse hits a place to a pixel or two.
        at = column + np.arange(-2, 3)
        columns = (at - WIDTH / 8)[:, None] + (pixels[:, 0] - 1.5) / 4
        rows = np.rint(CENTRE_PX[at] - HEIGHT / 8)[:, None] + (pixels[:, 1] - 1.5) / 4
        off = np.abs(rows - np.interp(columns, np.arange(WIDTH), CENTRE_PX))
        # Within a column, which has one dot, the stripe rises by its steepest.
        assert off.max(axis=1).min() <= 0.25 + np.abs(np.diff(CENTRE_PX)).max() / 2
        page.click("#zoom")
        after_pictures(page, 1)
        assert np.ptp(coloured(page, STRIPE)[:, 0]) == WIDTH - 1  # the whole again


def after_pictures(page: Page, count: int) -> None:
    drawn = page.evaluate("window.lscan.framesDrawn")
    wait_for(page, f"window.lscan.framesDrawn > {drawn + count}")


def click_on_picture(page: Page, share: float) -> None:
    """Click on the middle of its height, so far along its width."""
    box = "document.querySelector('#picture').getBoundingClientRect()"
    x, y, width, height = page.evaluate(
        f"(({{x, y, width, height}}) => [x, y, width, height])({box})"
    )
    page.mouse.click(x + share * width, y + height / 2)


@pytest.mark.slow
def test_without_a_calibration_the_page_says_so(page: Page, instrument: Instrument) -> None:
    instrument.state["calibration"] = None
    instrument.frame = {"profile": None}
    shows(page, "[data-number=sigma]", "take a board picture")
    shows(page, "#devices", "no calibration")
    assert page.evaluate("window.lscan.plot") is None
    drawn = page.evaluate("window.lscan.profilesDrawn")
    wait_for(page, f"window.lscan.framesDrawn > {drawn + 5}")
    assert page.evaluate("window.lscan.profilesDrawn") == drawn


# A change of the stripe in the answer; the number, its value, grade and verdict.
NUMBERS: list[tuple[dict[str, Any], str, str, str, str]] = [
    ({"clipped": 0}, "saturation", "0.0 %", "good", "not clipped"),
    ({"clipped": 3}, "saturation", "0.5 %", "good", "a few columns clipped"),
    ({"clipped": 124}, "saturation", "20.0 %", "bad", "too bright: shorten the exposure"),
    ({"snr": 5.0}, "snr", "5", "bad", "lengthen the exposure"),
    ({"slope": 0.02}, "slope", "−1.15 °", "", "2.0 px in 100 px"),
    ({"slope": -0.0014}, "slope", "+0.08 °", "", "0.1 px in 100 px"),
    ({"slope": None}, "slope", "–", "", ""),
    ({"width_px": 1.4}, "width", "1.4 px", "fair", "thin for a colour camera"),
    ({"width_px": 20.0}, "width", "20.0 px", "bad", "blurred"),
    ({"found": 0, "snr": None, "width_px": None}, "snr", "–", "", ""),
    ({"found": 200, "status": {"NO_PEAK": 440}}, "found", "200 of 640", "bad", "no peak 440"),
]


def test_each_number_has_its_verdict(page: Page, instrument: Instrument) -> None:
    stripe = {"axis": "columns", "centre_px": [], "found": 620, "of": 640, "clipped": 0}
    figures = {"width_px": 4.0, "snr": 40.0, "status": {}}
    for change, number, value, grade, verdict in NUMBERS:
        instrument.frame = {"stripe": {**stripe, **figures, **change}}
        tile = f"[data-number={number}]"
        shows(page, f"{tile} .value", value)
        assert page.evaluate(f"document.querySelector('{tile}').dataset.grade") == grade, change
        assert verdict in text(page, f"{tile} .verdict"), change


# A figure, the answer it is judged by, the member that varies, its limits, the grades between.
LIMITS: list[tuple[str, dict[str, Any], str, tuple[float, ...], str]] = [
    ("saturation", {"mode": "board"}, "saturated_percent", (0.5, 5), "good fair bad"),
    ("saturation", {"stripe": {"found": 1000}}, "clipped", (5, 50), "good fair bad"),
    ("snr", {"stripe": {}}, "snr", (8, 15), "bad fair good"),
    ("width", {"stripe": {}}, "width_px", (2.5, 4, 8), "fair good fair bad"),
    ("found", {"stripe": {"of": 100, "status": {}}}, "found", (50, 95), "bad fair good"),
    ("residual", {"board": {}}, "residual_rms_px", (0.2, 0.5), "good fair bad"),
    ("focus", {**ALIGNING, "focus_best": 100}, "focus", (80, 95), "bad fair good"),
]


def grade_and_legend(
    page: Page, name: str, frame: dict[str, Any], key: str, value: float
) -> tuple[str, str]:
    """The grade that the page's own figure of this name gives a value, and its legend."""
    inner = next((part for part in ("stripe", "board") if part in frame), None)
    shown = {**frame, inner: {**frame[inner], key: value}} if inner else {**frame, key: value}
    script = f"""import("/live/figures.js").then(({{FIGURES}}) => {{
        const figure = FIGURES.find((one) => one.name === {name!r});
        return [figure.judge({json.dumps(shown)})[0], figure.legend];
    }})"""
    grade, legend = page.evaluate(script)
    return grade, legend


def test_the_legend_names_each_limit_at_which_a_verdict_turns(page: Page) -> None:
    """Just below and just above each limit, the grades of a first picture are those there."""
    whole = page.evaluate("document.querySelector('#legend').textContent")
    for name, frame, key, values, grades in LIMITS:
        sides = grades.split()
        for limit, below, above in zip(values, sides[:-1], sides[1:], strict=True):
            assert grade_and_legend(page, name, frame, key, 0.999 * limit)[0] == below, key
            assert grade_and_legend(page, name, frame, key, 1.001 * limit)[0] == above, key
        legend = grade_and_legend(page, name, frame, key, 1.0)[1]
        named = [limit / 10 for limit in values] if key == "clipped" else values  # of 1000, in %
        assert [limit for limit in named if f" {limit:g} " not in legend.replace(",", " ")] == []
        assert legend in whole

    for words in ("0.5 mm", "2 mm", "0.1°", "10 drawn", "under 3"):
        assert words in whole


@pytest.mark.slow
def test_the_focus_bar_stands_against_the_best(page: Page, instrument: Instrument) -> None:
    instrument.state["calibration"] = None
    instrument.frame = {"focus": 30.0, "focus_best": 120.0}
    shows(page, "[data-number=focus]", "25 %")
    assert page.evaluate("document.querySelector('[data-number=focus] meter').value") == 0.25
    instrument.frame = {"focus": 120.0, "focus_best": 120.0}
    shows(page, "[data-number=focus]", "at its best")


# Every verdict that any picture can get, by frames far on either side of each limit.
VERDICTS = """import("/live/figures.js").then(({FIGURES}) => {
  const verdicts = [];
  for (const level of [1e-3, 3, 6, 12, 60, 1e3])
    for (const mode of ["stripe", "board"]) {
      const f = {
        mode, phase: "%s", focus: level, focus_best: 100, saturated_percent: level, rate_hz: 1,
        camera_hz: 1, exposure_ms: 1, position_mm: 1, board: null, profile: null,
        stripe: {axis: "columns", found: 100, of: 200, clipped: level, width_px: level,
                 snr: level, slope: level, status: {NO_PEAK: 100}},
      };
      for (const figure of FIGURES) verdicts.push(figure.judge(f)[1]);
    }
  return verdicts;
})"""


PHASES = [("alignment", True, True), ("calibrated", False, True), ("scan", False, False)]
OF_OPTICS = ("turn the lens", "focus the lens", "open the lens", "the sheet", "take a board")
FAULTS = {"wide", "blurred", "thin for a colour camera", "too bright", "weak", "not calibrated"}


def test_advice_about_optics_holds_in_alignment_alone(page: Page) -> None:
    """A calibration and a scan are those of the optics and the exposure they began with."""
    for phase, optics, exposure in PHASES:
        verdicts = set(page.evaluate(VERDICTS % phase))
        for words in OF_OPTICS:
            assert any(words in verdict for verdict in verdicts) is optics, (phase, words)
        for words in ("shorten", "lengthen"):
            assert any(words in verdict for verdict in verdicts) is exposure, (phase, words)
        assert {verdict.split(":")[0] for verdict in verdicts} >= FAULTS, phase


@pytest.mark.slow
def test_a_scan_shows_no_bar_to_be_filled(page: Page, instrument: Instrument) -> None:
    instrument.state["calibration"] = None
    instrument.frame = {"focus": 88.0, "focus_best": 100.0}
    shows(page, "[data-number=focus]", "turn the lens until the bar is full")
    instrument.scan_is("scanning")
    shows(page, "[data-number=focus]", "leave the optics as they are")
    assert page.evaluate("document.querySelector('[data-number=focus] meter').value") == 0


@pytest.mark.slow
def test_the_board_is_not_moved_while_a_scan_goes_on(page: Page, instrument: Instrument) -> None:
    instrument.state["mode"] = "board"
    shows(page, "#board-advice", "Move the board")
    instrument.scan_is("scanning")
    wait_for(page, "document.querySelector('#board-advice').innerText === ''")


@pytest.mark.slow
def test_the_verdict_of_a_width_does_not_flicker_at_a_limit(
    page: Page, instrument: Instrument
) -> None:
    """5 % on either side of 4 px: from 3.8 to 4.2 px it is what it was before."""
    stripe = instrument.next_frame(0)[0]["stripe"]  # type: ignore[index]
    steps = [
        (3.5, "good"), (4.15, "good"), (4.3, "fair"), (3.85, "fair"), (3.75, "good"),
        (2.4, "good"), (2.35, "fair"), (2.6, "fair"), (2.65, "good"),
        (20.0, "bad"), (7.7, "bad"), (7.55, "fair"),
    ]  # fmt: skip
    tile = "document.querySelector('[data-number=width]')"
    for width_px, grade in steps:
        instrument.frame = {"stripe": {**stripe, "width_px": width_px, "snr": 1000 * width_px}}
        shows(page, "[data-number=snr]", f"{1000 * width_px:.0f}")  # written with the width
        assert page.evaluate(f"{tile}.dataset.grade") == grade, width_px


def test_the_readme_gives_the_width_that_the_page_calls_good(page: Page) -> None:
    figure = "FIGURES.find((one) => one.name === 'width').legend"
    legend = page.evaluate(f"import('/live/figures.js').then(({{FIGURES}}) => {figure})")
    good = re.search(r"good from ([\d.]+) to ([\d.]+) px", legend)
    assert good is not None
    assert f"*Width.* {good[1]} to {good[2]} px, full width at half height" in GUIDE.read_text()


# ---- board mode -------------------------------------------------------------------------


def test_the_board_is_shown_with_its_marks_and_where_it_stands(
    page: Page, instrument: Instrument
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


OFFSETS: list[tuple[dict[str, float] | None, str]] = [
    ({"distance_mm": -2.5}, "Move the board 2.5 mm away from the camera; lean its top back"),
    ({"distance_mm": 0.2, "tilt_x_deg": -0.6}, "Lean its top forward by 0.6°."),
    ({"distance_mm": 0.2, "tilt_x_deg": 0.0}, "The board lies in the sheet, within 0.6 mm"),
    ({"tilt_x_deg": 0.0, "tilt_z_deg": 1.0}, "; turn its right side forward by 1.0°."),
    (None, "Add camera_mm to [sheet]"),
]


@pytest.mark.slow
def test_the_advice_undoes_the_offset(page: Page, instrument: Instrument) -> None:
    instrument.state["mode"] = "board"
    shows(page, "#board-advice", "Move the board")
    for offset, words in OFFSETS:
        board = board_answer()["board"]
        board["offset"] = {**board["offset"], **offset} if offset else None
        board["offset_message"] = "" if offset else "Add camera_mm to [sheet] of the rig file."
        instrument.frame = {"board": board}
        shows(page, "#board-advice", words)


@pytest.mark.slow
def test_a_board_that_is_not_found_says_why(page: Page, instrument: Instrument) -> None:
    lost = {"found": 0, "expected": 20, "message": "no dots in the picture", "marks_px": []}
    residuals = dict.fromkeys(["residual_rms_px", "residual_max_px", "residual_rms_mm"])
    instrument.frame = {"board": {**lost, **residuals, "offset": None, "age_s": 0.1}}
    page.keyboard.press("m")
    shows(page, "#board-advice", "no dots in the picture")
    assert "no board found" in text(page, "[data-number=marks]")


# ---- buttons and keys -------------------------------------------------------------------

JOGS = {"-10", "-1", "1", "10"}
FREE = {"start", "take-board", "laser", "go", *JOGS}
MODES = {"mode-stripe", "mode-board"}


STATES: list[tuple[str, int, set[str]]] = [
    ("idle", 0, FREE),
    ("scanning", 34, {"pause", "stop"}),
    ("paused", 34, {"resume", "stop", "laser", "go", *JOGS}),
    ("stopping", 34, set()),
    ("done", 100, FREE),
    ("failed", 34, FREE | {"resume"}),
]


def test_only_what_can_be_done_can_be_clicked(page: Page, instrument: Instrument) -> None:
    for state, done, allowed in STATES:
        instrument.scan_is(state, done)
        words = {"idle": "ready", "stopping": "stopping after this frame"}.get(state, state)
        shows(page, "#scan-state", words)
        assert enabled(page) == allowed | MODES, state


@pytest.mark.slow
def test_what_the_rig_lacks_cannot_be_clicked(page: Page, instrument: Instrument) -> None:
    instrument.state.update(board=False, can_switch_laser=False)
    instrument.state["track"]["position_mm"] = None
    instrument.frame = {"position_mm": None}
    wait_for(page, "document.querySelector('#laser').hidden")
    assert enabled(page) == {"start", "go", "mode-stripe"}


def test_clicks_send_their_commands(page: Page, instrument: Instrument) -> None:
    page.click("#target")
    page.keyboard.type("47.5")
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
        wait_for(page, f'!document.querySelector("{button}").disabled')
        page.click(button)
        assert wait_for_post(instrument, count) == (path, body)
    shows(page, "#task", "board picture: taking picture 1 of 4")
    assert "take-board" not in enabled(page)


@pytest.mark.slow
def test_quick_jogs_add_up(page: Page, instrument: Instrument) -> None:
    for _ in range(3):
        page.click(".jog[data-by='1']")
    wait_for_post(instrument, 3)
    assert [body["position_mm"] for _, body in instrument.posts] == [13.0, 14.0, 15.0]


@pytest.mark.slow
def test_an_overtaken_state_does_not_move_the_track_back(
    page: Page, instrument: Instrument
) -> None:
    instrument.state_answers = threading.Semaphore(0)
    wait_for_state_asked(instrument)  # at 12 mm; its answer arrives after those of two moves
    for _ in range(2):
        page.click(".jog[data-by='1']")
    wait_for_post(instrument, 2)
    instrument.state_answers.release()
    wait_for_state_asked(instrument)
    page.click(".jog[data-by='1']")
    assert wait_for_post(instrument, 3) == ("/api/move", {"position_mm": 15.0})


@pytest.mark.slow
def test_a_disabled_button_does_not_answer(page: Page, instrument: Instrument) -> None:
    page.click("#pause", force=True)  # without waiting until it is enabled
    page.keyboard.press("p")
    page.keyboard.press("Escape")
    page.keyboard.press("b")
    assert wait_for_post(instrument, 1) == ("/api/board", {})


def test_a_whole_scan_by_the_keyboard(page: Page, instrument: Instrument) -> None:
    page.evaluate("document.activeElement.blur()")
    for _ in range(30):
        if page.evaluate("document.activeElement.id") == "name":
            break
        page.keyboard.press("Tab")
    page.keyboard.type("bps")  # typed into the name, these are no shortcuts
    assert page.evaluate("document.querySelector('#name').value") == "bps"
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "start"
    page.keyboard.press("Enter")
    assert wait_for_post(instrument, 1) == ("/api/scan/start", {"name": "bps"})
    wait_for(page, "document.activeElement.id === 'pause'")  # the next thing to press
    page.keyboard.press(" ")
    assert wait_for_post(instrument, 2)[0] == "/api/scan/pause"
    wait_for(page, "document.activeElement.id === 'resume'")
    keys = [("p", "resume", "pause"), ("p", "pause", "resume"), ("p", "resume", "pause"),
            ("Escape", "stop", "resume")]  # fmt: skip
    for count, (key, path, next_button) in enumerate(keys, start=3):
        page.keyboard.press(key)
        assert wait_for_post(instrument, count)[0] == f"/api/scan/{path}"
        # What a key does depends on the state that the page knows of.
        wait_for(page, f"!document.querySelector('#{next_button}').disabled")
    shows(page, "#scan-note", "35 of 100 frames")
    shows(page, "#scan-state", "stopped")
    assert "resume" in enabled(page)


@pytest.mark.slow
def test_every_control_is_reached_by_tab(page: Page) -> None:
    page.evaluate("document.activeElement.blur()")
    reached = []
    for _ in range(30):
        page.keyboard.press("Tab")
        name = page.evaluate(
            "(({id, dataset, tagName}) => id || dataset.by || tagName)(document.activeElement)"
        )
        if name in reached:
            break
        reached.append(name)
    assert enabled(page) | {"equal", "name", "target", "SUMMARY"} <= set(reached)


# ---- progress and faults ----------------------------------------------------------------


@pytest.mark.slow
def test_the_progress_of_a_scan_is_shown(page: Page, instrument: Instrument) -> None:
    instrument.scan_is("scanning", 34)
    shows(page, "#scan-note", "34 of 100 frames · 0:16 left · 0:08 gone · runs/scan-003")
    assert page.evaluate("document.querySelector('#progress').value") == 0.34
    assert page.evaluate("document.title").startswith("34 %")


def test_faults_stand_in_the_alert_line_until_they_are_gone(
    chromium: Chromium, page: Page, instrument: Instrument
) -> None:
    assert page.evaluate("document.querySelector('#alert').checkVisibility()") is False
    instrument.refusal = "a scan is going on"
    page.click("#start")
    shows(page, "#alert", "a scan is going on")
    chromium.take_errors()  # the browser notes every refused request in its console
    instrument.state["camera"]["error"] = "no picture for 2.0 s"
    shows(page, "#alert", "Camera: no picture for 2.0 s")
    instrument.scan_is("failed", 34, message="the disk is full")
    shows(page, "#alert", "Scan: the disk is full")
    instrument.refusal = ""
    instrument.state["camera"]["error"] = ""
    page.click("#resume")
    wait_for(page, "document.querySelector('#alert').innerText === ''")


@pytest.mark.slow
def test_why_a_command_was_refused_is_not_said_through_a_whole_scan(
    chromium: Chromium, page: Page, instrument: Instrument
) -> None:
    instrument.refusal = "a scan is going on"
    page.click("#start")
    shows(page, "#alert", "a scan is going on")
    chromium.take_errors()  # the browser notes every refused request in its console
    instrument.scan_is("scanning", 34)
    page.evaluate("(now => { Date.now = () => now() + 11000; })(Date.now)")
    wait_for(page, "document.querySelector('#alert').innerText === ''")


def test_a_laser_that_may_be_lit_is_said_also_without_a_server(chromium: Chromium) -> None:
    page, instrument = chromium.page, Instrument()
    instrument.state["laser_warning"] = "the laser may still be lit"
    with served(instrument) as url:
        page.goto(url)
        shows(page, "#alert", "Laser: it may still be lit: switch it off at its supply")
        instrument.state["laser_warning"] = ""
        wait_for(page, "document.querySelector('#alert').innerText === ''")
    wait_for(page, "document.querySelector('#connection').innerText === 'not live'")
    shows(page, "#alert", "Laser: it may still be lit")
    shows(page, "#alert", "trying again")
    chromium.take_errors()
    page.goto("about:blank")


GREY = "getComputedStyle(document.querySelector('#picture')).filter.includes('grayscale')"
DAY_S = 86_400


def test_a_camera_that_is_gone_leaves_no_picture_that_looks_alive(
    page: Page, instrument: Instrument
) -> None:
    assert text(page, "#since") == ""
    assert page.evaluate(GREY) is False
    instrument.stuck = True
    camera = instrument.state["camera"]
    camera.update(gone=True, seen_s_ago=7200.0, error="no picture for 2.0 s")
    shows(page, "#connection", "not live")
    found = re.search(r"^last picture at .*(\d\d):(\d\d):(\d\d)$", text(page, "#since"))
    assert found is not None
    seen_s = np.dot([3600, 60, 1], [int(number) for number in found.groups()])
    now = page.evaluate("((d) => [d.getHours(), d.getMinutes(), d.getSeconds()])(new Date())")
    ago_s = (np.dot([3600, 60, 1], now) - seen_s) % DAY_S
    assert 7200 - 1 <= ago_s <= 7200 + 60  # rounded to a second; read within a minute
    assert page.evaluate(GREY)
    # The track answers still; nothing that needs a picture can be asked for.
    assert enabled(page) == {"laser", "go", *JOGS} | MODES
    assert text(page, "#alert") == "Camera: no picture for 2.0 s"
    instrument.stuck = False
    camera.update(gone=False, seen_s_ago=0.0, error="")
    wait_for(page, "document.querySelector('#connection').innerText === 'live'")
    assert (text(page, "#since"), text(page, "#alert"), page.evaluate(GREY)) == ("", "", False)
    assert enabled(page) == FREE | MODES


@pytest.mark.slow
def test_a_fault_is_shown_once(chromium: Chromium, page: Page, instrument: Instrument) -> None:
    """What a device did to a command and to the scan is not shown beside the device's own fault."""

    def counts(word: str) -> int:
        return str(page.evaluate("document.body.innerText")).count(word)

    instrument.refusal, instrument.by_device = "the cable: cannot be opened", True
    page.click("#start")
    shows(page, "#alert", "the cable: cannot be opened")
    chromium.take_errors()  # the browser notes every refused request in its console
    instrument.state["track"]["error"] = "the cable is gone"
    instrument.scan_is("failed", 34, message="frame 35: no answer of the cable", by_device=True)
    shows(page, "#alert", "the cable is gone")
    wait_for(page, "document.body.dataset.scan === 'failed'")
    assert counts("cable") == 1
    instrument.state["track"]["error"] = ""
    shows(page, "#alert", "no answer of the cable")  # why the scan failed is still to be known
    assert counts("cable") == 1
    instrument.state["track"]["error"] = "the cable is gone"
    instrument.scan_is("failed", 34, message="the disk is full")  # another fault
    shows(page, "#alert", "the disk is full")
    assert (counts("cable"), counts("disk")) == (1, 1)


@pytest.mark.slow
def test_a_server_that_went_away_is_waited_for(chromium: Chromium) -> None:
    page = chromium.page
    first = Instrument()
    with served(first) as url:
        page.goto(url)
        wait_for(page, "window.lscan?.framesDrawn > 20")
    wait_for(page, "document.querySelector('#connection').innerText === 'not live'")
    assert "trying again" in text(page, "#alert")
    assert "last picture at" in text(page, "#since")
    assert page.evaluate(GREY)
    assert enabled(page) == set()
    drawn = page.evaluate("window.lscan.framesDrawn")
    with served(Instrument(), urlsplit(url).port or 0):  # its numbers begin at 1 again
        wait_for(page, f"window.lscan.framesDrawn > {drawn + 3}")
        wait_for(page, "document.querySelector('#connection').innerText === 'live'")
        assert text(page, "#alert") == ""
        assert enabled(page) == FREE | MODES
        assert page.evaluate(GREY) is False
        errors = chromium.take_errors()
        assert errors, "the lost server stands in the console"
        assert all("net::ERR_" in error for error in errors)
        page.goto("about:blank")
    chromium.take_errors()


def test_a_token_is_asked_for_and_kept(chromium: Chromium) -> None:
    page = chromium.page
    instrument = Instrument()
    instrument.token = "one-two-three"
    with served(instrument) as url:
        page.goto(url)
        assert "Open the address with its token" in page.evaluate("document.body.innerText")
        page.goto(f"{url}?token=one-two-three")
        wait_for(page, DRAWING)
        page.click("#start")
        assert wait_for_post(instrument, 1)[0] == "/api/scan/start"
        instrument.token = "another"  # the server was started anew
        shows(page, "#alert", "Open the address with its token")
        shows(page, "#connection", "not live")
        page.goto("about:blank")
    chromium.take_errors()


@pytest.mark.slow
def test_a_hidden_page_asks_for_no_pictures(page: Page) -> None:
    page.evaluate(
        "Object.defineProperty(document, 'hidden', {get: () => window.covered, configurable: true})"
    )
    page.evaluate("window.covered = true")
    wait_for(page, "(window.lscan.seen ??= window.lscan.framesDrawn) && true")
    page.evaluate("new Promise((go) => setTimeout(go, 300))")  # the picture on its way
    drawn = page.evaluate("window.lscan.framesDrawn")
    page.evaluate("new Promise((go) => setTimeout(go, 500))")
    assert page.evaluate("window.lscan.framesDrawn") == drawn
    page.evaluate("window.covered = false; document.dispatchEvent(new Event('visibilitychange'))")
    wait_for(page, f"window.lscan.framesDrawn > {drawn}")


# ---- on a phone, and pictures to look at ------------------------------------------------


@pytest.mark.slow
def test_a_phone_shows_one_column_with_room_for_fingers(
    phone: Page, instrument: Instrument
) -> None:
    instrument.scan_is("scanning")
    instrument.state["scan"]["folder"] = "runs/" + "a-long-name-" * 6
    resize(phone, 360, 740)
    shows(phone, "#scan-state", "scanning")
    phone.click("summary")
    for mode in ("stripe", "board"):
        instrument.state["mode"] = mode
        wait_for(phone, f"document.body.dataset.mode === '{mode}'")
        assert phone.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [360, 360]
        beyond = phone.evaluate(
            "[...document.querySelectorAll('body *')].filter((one) => one.checkVisibility() "
            "&& !one.closest('.unseen') && one.getBoundingClientRect().right > 360.5)"
            ".map((one) => one.outerHTML.slice(0, 80))"
        )
        assert beyond == []
        small = phone.evaluate(
            "[...document.querySelectorAll("
            "'button, input:not([type=checkbox]), label.check, summary')]"
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


IN_VIEW = """(() => {
  const one = document.querySelector("%s"), box = one.getBoundingClientRect();
  const bar = document.querySelector(".bar");
  const end = bar.contains(one) ? innerHeight : bar.getBoundingClientRect().top;
  return box.height > 0 && box.top >= 0 && box.bottom <= end;
})()"""


SIZES = [(360, 740), (740, 360), (390, 844), (844, 390)]


@pytest.mark.slow
def test_a_phone_keeps_the_buttons_of_a_scan_within_reach(
    phone: Page, instrument: Instrument
) -> None:
    for count, size in enumerate(SIZES, start=1):
        resize(phone, *size)
        instrument.state["scan"] = Instrument().state["scan"]
        shows(phone, "#scan-state", "ready")
        phone.evaluate("scrollTo(0, 0)")
        assert phone.evaluate(IN_REACH) == ["start"]
        states = [("scanning", ["pause", "stop"]), ("paused", ["resume", "stop"])]
        for state, buttons in states:
            instrument.scan_is(state)
            shows(phone, "#scan-state", state)
            for scroll_px in (0, 300, 10_000):
                phone.evaluate(f"scrollTo(0, {scroll_px})")
                assert phone.evaluate(IN_REACH) == buttons
                for part in ("#progress", "#scan-note"):
                    assert phone.evaluate(IN_VIEW % part), part
            phone.evaluate("scrollTo(0, 0)")
            assert phone.evaluate(IN_VIEW % "#picture")
            phone.evaluate("scrollTo(0, 10_000)")
        # Scrolled to its end, the page ends above the bar, which hides nothing.
        bar, end = phone.evaluate(
            "['.bar', 'main'].map((one) => document.querySelector(one)"
            ".getBoundingClientRect()).map((box) => [box.top, box.bottom])"
        )
        assert end[1] <= bar[0] + 0.5  # scrolled to whole device pixels
        phone.evaluate("scrollTo(0, 0)")
        phone.click("#stop")
        assert wait_for_post(instrument, count) == ("/api/scan/stop", {})
        phone.evaluate("scrollTo(0, 0)")
        wait_for(phone, f"{IN_REACH}.join() === 'start,resume'")


@pytest.mark.slow
def test_what_is_reached_by_tab_is_not_under_the_bar(phone: Page, instrument: Instrument) -> None:
    resize(phone, 360, 740)
    instrument.scan_is("paused")
    shows(phone, "#scan-state", "paused")
    phone.evaluate("document.activeElement.blur()")
    reached = set()
    for _ in range(20):
        phone.keyboard.press("Tab")
        name, covered = phone.evaluate(
            "(() => { const one = document.activeElement, box = one.getBoundingClientRect();"
            "const bar = document.querySelector('.bar');"
            "return [one.id || one.dataset.by || one.tagName,"
            "one !== document.body && !bar.contains(one)"
            " && box.bottom > bar.getBoundingClientRect().top]; })()"
        )
        if name in reached:
            break
        assert not covered, name
        reached.add(name)
    assert {"10", "target", "resume", "stop"} <= reached


# ---- the browser itself -----------------------------------------------------------------
