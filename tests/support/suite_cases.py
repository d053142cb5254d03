"""A small suite of drawn lines, as a folder: what reading and judging are tested on."""

import numpy as np

from lscan.benchmark.pictures import LineCase, centres, draw
from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Status
from lscan.suites import CaseTruth, SuiteCase, write_case, write_manifest

NOISE = NoiseSection(read_dn=1.0, dn_per_electron=255 / 15_000)


def drawn_case(number, peak_dn=150.0, turned=False, dark=False):
    """A case of one drawn line; the first ten columns are said to hold none."""
    rng = np.random.default_rng([7, number])
    true = centres(rng.uniform(-0.5, 0.5))
    image = draw(LineCase("tap", 1.5, peak_dn, NOISE), true, rng)
    picture = np.repeat(image[..., None], 3, axis=2)
    status = np.full(len(true), int(Status.OK))
    status[:10] = int(Status.NO_PEAK)
    picture[:, :10] = 4
    shown = np.where(status == Status.OK, true, np.nan)
    sizes = [np.full(len(true), value) for value in (1.5, peak_dn, 1.0)]
    truth = CaseTruth(shown, *sizes, np.zeros(len(true), dtype=int), status)
    labels = np.zeros(image.shape, np.uint8)
    settings = StripeSection(threshold_dn=8.0, noise=NOISE)
    background = np.full_like(picture, 4) if dark else None
    if turned:
        picture, labels = picture.transpose(1, 0, 2).copy(), labels.T.copy()
        background = None if background is None else background.transpose(1, 0, 2).copy()
        settings = settings.model_copy(update={"axis": "rows"})
    axes = {"water": "tap", "target": f"peak {peak_dn:g}", "fault": "turned" if turned else "none"}
    return SuiteCase(f"case-{number:03d}", axes, picture, background, labels, truth, settings)


def drawn_suite(folder, count=4, name="drawn"):
    """A suite's folder of ``count`` cases: turned ones, dim ones, one with its background."""
    cases = [
        drawn_case(n, 150.0 if n % 3 else 30.0, turned=n % 2 == 1, dark=n == 0)
        for n in range(count)
    ]
    for case in cases:
        write_case(folder, case)
    axes = {case.name: dict(case.axes) for case in cases}
    write_manifest(folder, name, 7, "lscan test", axes)
    return cases
