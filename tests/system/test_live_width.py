"""The width that the live page calls good is the one at which a line is found best."""

import re

import numpy as np
import pytest
from scipy.special import erf

from lscan.config.rig import StripeSection
from lscan.live.analysis import FULL_WIDTH, measure_line
from lscan.live.server import FOLDER
from sim.sensor.webcam import ColourFilter

HEIGHT, WIDTH = 80, 320
CENTRE_PX = 30.0 + 0.0613 * np.arange(WIDTH)  # in turn anywhere in a pixel
LIGHT_DN = 500.0  # of a column, the same at each width: 200 at the crest of one 2.35 px wide
READ_DN, DN_PER_ELECTRON = 1.0, 0.017  # of the paper's camera


def width_and_error(
    full_width_px: float, extractor: str = "ml", repeats: int = 3
) -> tuple[float, float]:
    """The page's width of a line drawn so wide for a colour camera, and the centre's rms error.

    The line is integrated over each pixel; the noise is the sensor's, the mosaic interpolated.
    """
    generator = np.random.default_rng(17)
    colour = ColourFilter("RGGB", (HEIGHT, WIDTH))

    def below(edge_px: np.ndarray) -> np.ndarray:
        return 0.5 * (1 + erf((edge_px - CENTRE_PX) * FULL_WIDTH / full_width_px / np.sqrt(2)))

    rows = np.arange(HEIGHT)[:, None]
    seen = np.full((HEIGHT, WIDTH, 3), 8.0)
    seen[..., 0] += LIGHT_DN * (below(rows + 0.5) - below(rows - 0.5))
    widths, errors = [], []
    settings = StripeSection(extractor=extractor, threshold_dn=20)
    for _ in range(repeats):
        noise = generator.normal(size=seen.shape) * np.sqrt(READ_DN**2 + DN_PER_ELECTRON * seen)
        picture = colour.demosaic(colour.mosaic((seen + noise).astype(np.float32)))
        line = measure_line(np.clip(np.rint(picture), 0, 255).astype(np.uint8), settings, None).line
        assert line is not None
        assert line.width_px is not None
        widths.append(line.width_px)
        errors.append((line.stripe.centre_px - CENTRE_PX)[4:-4])  # the mosaic ends there
    return float(np.mean(widths)), float(np.sqrt(np.nanmean(np.square(errors))))


@pytest.fixture(scope="module")
def limits() -> dict[str, float]:
    """Those of the page: thin, good and bad."""
    found = re.search(r"WIDTH_PX = \{(.*?)\}", (FOLDER / "stripefigures.js").read_text())
    assert found is not None
    pairs = (pair.split(":") for pair in found[1].split(","))
    return {name.strip(): float(value) for name, value in pairs}


@pytest.mark.slow
def test_a_line_of_good_width_is_found_best(limits: dict[str, float]) -> None:
    """Within the limits an error is at most half as much again as the least there is.

    Beyond the limit called bad, the noise of the many pixels makes it at least twice.  Thinner, the
    mosaic, which leaves red on every other row, makes it at least three times as much by
    extractors that read the rows filled in between; ``ml`` does not, and finds it from 2 px on.
    """
    full_px = (1.2, 2.0, 2.6, 3.0, 3.5, 3.8, 5.0, 10.0)
    lines = [width_and_error(w) for w in full_px[1:]]
    least = min(error for _, error in lines)
    good = [error for width, error in lines if limits["thin"] <= width <= limits["good"]]
    assert len(good) == 3
    assert max(good) <= 1.5 * least
    bad = [error for width, error in lines if width > limits["bad"]]
    assert len(bad) == 1
    assert min(bad) >= 2 * least
    filled_in = [width_and_error(w, "gaussian")[1] for w in full_px]
    thin = [e for w, e in zip(full_px, filled_in, strict=True) if w < limits["thin"]]
    assert len(thin) == 2
    assert min(thin) >= 3 * min(filled_in)
