"""The catalogue of parts: what it must say of each, and that each choice of parts is a scene."""

import copy
import tomllib
from pathlib import Path

import numpy as np
import pytest
from places import SCENES

from lscan.config.documents import Document, write_toml
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import InputError
from sim.scene import scene_of
from sim.studies.design.catalogue import Catalogue, load_catalogue
from sim.studies.design.rig import RigDesign, diffraction_um, document_of

SHIPPED = SCENES / "studies" / "catalogue.toml"
PRICE = {"eur": 1.0, "year": 2020, "standing": "recalled"}
KINDS = ("camera", "lens", "laser", "window", "track")


@pytest.fixture(scope="module")
def catalogue() -> Catalogue:
    return load_catalogue()


@pytest.fixture(scope="module")
def base() -> Document:
    return load_rig("best/sandwave").document


def changed(path: Path, kind: str, **keys: object) -> Path:
    """A file of the shipped catalogue with keys of the first part of a kind set, or left out."""
    document = copy.deepcopy(tomllib.loads(SHIPPED.read_text(encoding="utf-8")))
    for key, value in keys.items():
        if value is None:
            del document[kind][0][key]
        else:
            document[kind][0][key] = value
    write_toml(path / "parts.toml", document)
    return path / "parts.toml"


def test_there_is_enough_to_choose_from_and_each_part_has_a_source(catalogue: Catalogue) -> None:
    assert len(catalogue.camera) >= 20
    assert len(catalogue.laser) >= 10
    assert min(len(getattr(catalogue, kind)) for kind in KINDS) >= 3
    for part in (part for kind in KINDS for part in getattr(catalogue, kind)):
        assert part.source[0].title and part.price.eur > 0, part.name


@pytest.mark.parametrize(
    ("kind", "keys", "named"),
    [
        ("camera", {"pixels": 3}, "camera.0.pixels: unknown key"),
        ("laser", {"price": PRICE | {"eur": -1.0}}, "laser.0.price.eur: must be"),
        ("camera", {"built_in": None, "standing": {}}, "exactly one of mount and built_in"),
    ],
)  # fmt: skip
def test_a_wrong_part_is_one_line_that_names_file_and_key(
    tmp_path: Path, kind: str, keys: dict[str, object], named: str
) -> None:
    file = changed(tmp_path, kind, **keys)
    with pytest.raises(InputError) as refused:
        load_catalogue(file)
    line = str(refused.value)
    assert line.startswith(f"{file}: ") and named in line and "\n" not in line


def test_each_camera_with_each_lens_that_fits_and_each_laser_is_a_scene(
    catalogue: Catalogue, base: Document
) -> None:
    """Each sight with one laser and each laser with one sight: what either sets is its own.

    Windows and tracks go in turn.
    """
    sights, lasers = list(catalogue.sights.values()), catalogue.laser
    pairs = [(sight, lasers[n % len(lasers)]) for n, sight in enumerate(sights)]
    pairs += [(sights[0], laser) for laser in lasers]
    for number, ((camera, lens), laser) in enumerate(pairs):
        window = catalogue.window[number % len(catalogue.window)]
        track = catalogue.track[number % len(catalogue.track)]
        document = document_of(RigDesign(camera, lens, laser, window, track), base)
        scene = scene_of(parse_rig(document, source=camera.name))
        assert scene.rig.camera.size_px == (camera.width_px, camera.height_px)
        assert scene.tank.laser.power_mw == laser.power_mw
        assert scene.tank.port.thickness_mm == window.thickness_mm
        assert scene.tank.track_errors == track.errors
        if lens is not None:
            assert lens.circle_mm >= camera.diagonal_mm
            # The field of view of a pinhole: half the sensor over the focal length.
            half = camera.width_px * camera.pixel_um / 2e3
            assert camera.width_px / 2 / scene.tank.lens.focal_px == pytest.approx(
                half / lens.focal_mm
            )


def test_a_stated_field_of_view_is_the_picture_s_diagonal(
    catalogue: Catalogue, base: Document
) -> None:
    camera, lens = catalogue.sights["logitech-c920"]
    parts = catalogue.laser[0], catalogue.window[0], catalogue.track[0]
    focal_px = document_of(RigDesign(camera, lens, *parts), base)["lens"]["focal_px"]
    # Its own source gives 70.42 degrees across and 43.3 down, to the digits printed there.
    across, down = (2 * np.degrees(np.arctan(side / 2 / focal_px)) for side in (1920, 1080))
    assert across == pytest.approx(70.42, abs=0.05)
    assert down == pytest.approx(43.3, abs=0.1)


def test_an_owner_states_what_the_rig_is(catalogue: Catalogue, base: Document) -> None:
    """[optics], [stripe.noise] and [sheet] of the base follow the parts."""
    camera, _ = catalogue.sights["sony-ps3-eye-close"]
    green = next(part for part in catalogue.laser if part.wavelength_nm == 520.0)
    window = next(part for part in catalogue.window if part.name == "n-bk7-10mm")
    document = document_of(RigDesign(camera, None, green, window, catalogue.track[0]), base)
    optics = document["optics"]
    assert optics["focal_px"][0] == document["lens"]["focal_px"]
    assert optics["thickness_mm"][0] == 10.0
    # Schott's data sheet N-BK7 517642.251 on either side of 520 nm: n_e and n_F'.
    assert 1.51872 < optics["glass_index"][0] < 1.52283
    # Water is denser to green light.
    assert optics["water_index"][0] > base["optics"]["water_index"][0]
    assert document["stripe"]["channel"] == "green"
    assert document["stripe"]["noise"]["dn_per_electron"] == pytest.approx(255 / (900 * 36.0))
    assert document["sheet"]["thickness_mm"] == green.waist_mm
    assert document["sheet"]["camera_mm"] == pytest.approx(document["head"]["camera_mm"])


def test_diffraction_is_as_wide_as_the_literature_says() -> None:
    # Zhang et al. 2007 give 0.225 lambda / NA, so 0.45 lambda N.
    assert diffraction_um(2.8, 650.0) == pytest.approx(0.45 * 0.65 * 2.8, rel=1e-3)
