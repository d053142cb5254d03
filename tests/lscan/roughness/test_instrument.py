"""Response, cutoff, ripples, and the command."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from rough_patches import drawn, holes, patch, wave, whole
from typer.testing import CliRunner

from lscan.cli.app import app
from lscan.cli.report import MOST_STEPS
from lscan.errors import InputError, MeasurementError
from lscan.files.pictures import read_picture
from lscan.records import Status, Surface
from lscan.roughness import (
    Patch,
    PowerLaw,
    Roughness,
    ScannerResponse,
    cutoff_per_cm,
    find_ripples,
    fit_waves,
    noise_density,
    patch_of,
    patch_of_cells,
    patch_of_profiles,
    roughness_of,
    structure_function,
)
from lscan.roughness.analysis import save_figures
from lscan.roughness.patch import wavenumbers
from lscan.surface import grid_cells, load_surface, save_surface
from tests.validation.roughness.profiles import profile_waves

CELL_CM = 0.1


def test_a_cell_passes_what_its_quadratic_keeps() -> None:
    """grid_cells itself on waves of known length: the amplitude that is left, squared."""
    cell_mm, fine = 2.0, 0.1
    x, y = np.meshgrid(np.arange(0, 80, fine) + fine / 2, np.arange(0, 4, fine) + fine / 2)
    for waves in (2, 10, 17):
        k = 2 * np.pi * waves / 80
        z = np.cos(k * x)
        status = np.full(z.shape, int(Status.OK))
        surface = Surface(
            np.stack([x, y, z], axis=-1), 0 * z, 0 * z + 0.1, status, y[:, 0], "workpiece"
        )
        grid = grid_cells(surface, cell_mm)
        left = grid.z_mm[0] @ np.cos(k * grid.x_mm) / (len(grid.x_mm) / 2)
        passed = ScannerResponse(cell_cm=cell_mm / 10)(0.0, k * 10)
        assert float(passed) == pytest.approx(left**2, rel=0.01)


def test_a_response_s_lengths_act_along_their_own_axes() -> None:
    response = ScannerResponse(sheet_cm=0.1, pixel_cm=0.2)
    assert response(5.0, 0.0) == pytest.approx((0.75 * np.exp(-0.125)) ** 2)
    assert ScannerResponse(blur_cm=0.1)(7.0, 5.0) == pytest.approx(np.exp(-0.25))
    assert response(0.0, 5.0) == pytest.approx((np.sin(0.5) / 0.5) ** 2)
    seen_aside = ScannerResponse(sheet_cm=0.1, aside=(-0.2, 0.2))
    assert seen_aside(0.0, 5.0) == pytest.approx((0.99 * np.exp(-0.005)) ** 2)
    with pytest.raises(InputError, match="sheet_cm"):
        ScannerResponse(sheet_cm=-1.0)


def test_noise_alone_ends_at_a_decibel() -> None:
    """Where W2 = noise / (10^0.1 - 1), of a power law in closed form."""
    law = PowerLaw(3.0, 0.004)
    one = patch(np.zeros((64, 64)), None, CELL_CM, noise_cm2=1e-3)
    expected = (law.w2_cm4 * (10**0.1 - 1) / noise_density(one)) ** (1 / 3)
    assert cutoff_per_cm(law, one, ScannerResponse()) == pytest.approx(expected, rel=0.005)
    quiet = whole(np.zeros((64, 64)), CELL_CM)
    assert cutoff_per_cm(law, quiet, ScannerResponse()) == quiet.nyquist_per_cm


@pytest.mark.parametrize(
    "heading_deg", [*(pytest.param(one, marks=pytest.mark.slow) for one in (10.0, 90.0)), 140.0]
)
def test_ripples_are_found_in_rough_ground(heading_deg: float) -> None:
    """Wavelength to 1 %, heading to 1 degree, height to 3 %, as is required; of sharp crests."""
    shape, waves = (96, 96), 7.3
    crests = wave(shape, CELL_CM, waves, heading_deg, 0.2)
    crests = crests + wave(shape, CELL_CM, 2 * waves, heading_deg, 0.05)
    z, _ = drawn(PowerLaw(3.0, 2e-5), shape, CELL_CM, 4)
    found = find_ripples(whole(z + crests, CELL_CM))
    assert found is not None
    assert found.wavelength_cm == pytest.approx(9.6 / waves, rel=0.01)
    off = (found.heading_deg - heading_deg + 90) % 180 - 90
    assert abs(off) < 1.0
    assert found.height_cm == pytest.approx(np.ptp(0.2 * np.cos(t := np.linspace(0, 7, 999))
                                                   + 0.05 * np.cos(2 * t)), rel=0.03)  # fmt: skip


def test_sigma_of_a_train_of_ripples_is_its_scatter() -> None:
    """Along the heading and across it, in a patch four times as long as it is wide.

    The scatter of 50 fits is known to 1 / sqrt(100) of itself, 4 of which are allowed for.
    """
    shape, noise_cm, rng = (96, 24), 0.02, np.random.default_rng(9)
    crests = wave(shape, CELL_CM, 12.0, 60.0, 0.2)
    start = 2 * np.pi / 0.8 * np.array([np.sin(np.pi / 3), np.cos(np.pi / 3)])
    fits = [
        fit_waves(whole(crests + rng.normal(0, noise_cm, shape), CELL_CM), start, 1)
        for _ in range(50)
    ]
    for name in ("wavelength_cm", "heading_deg"):
        scatter = np.std([getattr(fit, name) for fit in fits], ddof=1)
        stated = np.median([getattr(fit, f"sigma_{name}") for fit in fits])
        assert scatter == pytest.approx(stated, rel=4 / 100**0.5), name


def test_sigma_of_a_train_knows_that_the_ground_is_not_white() -> None:
    """The errors over their sigmas, of wavelength and heading, on ground of a power law with holes:
    the mean square of 32 is within a factor of two, beyond which it is once in 1,000."""
    shape, seen, off = (64, 64), holes((64, 64), 0.1, 3), list[float]()
    start = 2 * np.pi * 5 / 6.4 * np.array([np.sin(0.7), np.cos(0.7)])
    crests = wave(shape, CELL_CM, 5.0, np.degrees(0.7), 0.2)
    for seed in range(8):
        for z in drawn(PowerLaw(3.0, 2e-4), shape, CELL_CM, seed):
            train = fit_waves(patch(z + crests, seen, CELL_CM), start, 1)
            off += [(train.wavelength_cm - 1.28) / train.sigma_wavelength_cm,
                    (train.heading_deg - np.degrees(0.7)) / train.sigma_heading_deg]  # fmt: skip
    assert 0.5 < np.mean(np.square(off)) < 2.0


def test_rough_ground_alone_has_no_ripples() -> None:
    """Of 1,000 fields some 5 may chance to have a peak; see ABOVE."""
    fields = [z for seed in range(3) for z in drawn(PowerLaw(3.0, 0.004), (48, 48), 0.1, seed)]
    assert not any(find_ripples(whole(z, CELL_CM)) for z in fields)


@pytest.mark.parametrize("gamma2", [2.5, 3.8])
def test_holes_make_no_ripples(gamma2: float) -> None:
    """A profile, a track along it and a square missing: leakage along the axes is expected."""
    for number, hole in enumerate((np.s_[19:20], np.s_[:, 25:26], np.s_[12:22, 5:15])):
        seen = np.ones((40, 40), dtype=bool)
        seen[hole] = False
        z, _ = drawn(PowerLaw(gamma2, 0.004), seen.shape, CELL_CM, number, 4)
        assert find_ripples(patch(z, seen, CELL_CM)) is None


@pytest.mark.slow  # rough ground alone, above
def test_what_a_scanner_smooths_has_no_ripples() -> None:
    """Directions in which little is passed make no others stand out, nor does noise where nothing
    is, whether the response is told or not."""
    response = ScannerResponse(blur_cm=0.15, pixel_cm=0.1)
    noise = 0.002
    rng = np.random.default_rng(3)
    found = []
    for seed in range(10):
        for z in drawn(PowerLaw(3.0, 0.004), (64, 64), CELL_CM, seed):
            y, x = wavenumbers(z.shape, CELL_CM)
            seen = np.fft.ifft2(np.fft.fft2(z) * np.sqrt(response(y, x))).real
            one = patch(seen + rng.normal(0, noise, z.shape), None, CELL_CM, noise**2)
            found += [find_ripples(one), find_ripples(one, response=response)]
    assert sum(train is not None for train in found) <= 2


@pytest.fixture(scope="module")
def surface_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A surface of four points a cell of 2 mm, 80 x 64 mm."""
    law, cell = PowerLaw(3.2, 0.004), 0.05
    z_cm, _ = drawn(law, (160, 128), cell, 9)
    y, x = (np.indices(z_cm.shape) + 0.5) * cell * 10
    rng = np.random.default_rng(9)
    z = 10 * z_cm + rng.normal(0, 0.02, z_cm.shape)
    status = np.where(rng.random(z.shape) > 0.05, int(Status.OK), int(Status.NO_DATA))
    z = np.where(status == Status.OK, z, np.nan)
    sigma = np.where(status == Status.OK, 0.02, np.nan)
    xyz = np.stack([np.where(status == Status.OK, x, np.nan), y, z], axis=-1)
    file = tmp_path_factory.mktemp("rough") / "surface.nc"
    save_surface(file, Surface(xyz, 0 * sigma, sigma, status, y[:, 0], "workpiece"))
    return file


def test_the_command_says_shows_and_keeps(
    surface_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_whole = list[Roughness]()

    def once(*args: Any, **options: Any) -> Roughness:
        kept_whole.append(roughness_of(*args, **options))
        return kept_whole[-1]

    monkeypatch.setattr("lscan.roughness.roughness_of", once)
    monkeypatch.setattr("lscan.roughness.analysis.png", lambda figure: b"")  # a slow test has them
    said = CliRunner().invoke(
        app,
        ["roughness", str(surface_file), "--cell", "2", "--json", "-o", str(tmp_path / "r.nc"),
         "--figures", str(tmp_path / "figures")],
    )  # fmt: skip
    assert said.exit_code == 0, said.output
    found = json.loads(said.stdout)
    assert found["gamma2_low"] < 3.2 < found["gamma2_high"]
    assert "ripple_height_cm" not in found
    assert found["cutoff_per_cm"] <= np.pi / 0.2
    assert found["w2_low_cm4"] < 0.004 < found["w2_high_cm4"]
    with xr.open_dataset(tmp_path / "r.nc") as kept:
        assert kept.attrs["gamma2"] == pytest.approx(found["gamma2"])
        assert (kept["w2_ring_low"] < kept["w2_ring"]).sum() > 10
        assert kept["w2"].dims == ("ky", "kx") and kept["w2"].attrs["units"] == "cm4"
    assert {file.name for file in (tmp_path / "figures").iterdir()} == {
        "spectrum.png", "plane.png", "rose.png",
    }  # fmt: skip
    assert "does not follow" not in said.stderr

    def lacking(*args: Any, **options: Any) -> Roughness:
        return replace(kept_whole[0], fit=replace(kept_whole[0].fit, lack=2.3))

    monkeypatch.setattr("lscan.roughness.roughness_of", lacking)
    plain = CliRunner().invoke(
        app, ["roughness", str(surface_file), "--cell", "2", "--sediment", "fine sand"]
    )
    assert "does not follow the power law" in " ".join(plain.stderr.split())
    assert "2.3 times as wide" in " ".join(plain.stderr.split())
    assert plain.exit_code == 0 and "spectral exponent" in plain.output
    assert "backscatter of fine sand" in plain.output


@pytest.mark.slow
def test_figures_are_pictures(surface_file: Path, tmp_path: Path) -> None:
    one = patch_of(grid_cells(load_surface(surface_file), 2.0))
    save_figures(tmp_path, one, roughness_of(one), ScannerResponse())
    assert all(read_picture(file).std() > 10 for file in tmp_path.iterdir())


def test_the_command_says_that_steps_lie_in_the_patch(
    surface_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block's top 10 mm up on a quarter; a stone of 8 mm is none, nor is the ground alone."""
    surface = load_surface(surface_file)
    x, y, _ = np.moveaxis(surface.xyz_mm, -1, 0)
    for where, told in ((x < 0, False), (np.hypot(x - 30, y - 40) < 4, False),
                        ((x < 30) & (y < 38), True)):  # fmt: skip
        raised = surface.xyz_mm + np.where(where, 10.0, 0.0)[..., None] * [0.0, 0.0, 1.0]
        assert (patch_of_cells(replace(surface, xyz_mm=raised), 2.0).steps > MOST_STEPS) == told
    save_surface(tmp_path / "raised.nc", replace(surface, xyz_mm=raised))
    monkeypatch.setattr("lscan.roughness.roughness_of", lambda *_, **__: 1 / 0)
    said = CliRunner().invoke(app, ["roughness", str(tmp_path / "raised.nc"), "--cell", "2"])
    assert "steps lie in the patch" in " ".join(said.stderr.split())
    read = list[Patch]()

    def patch_alone(patch: Patch, *_: Any, **__: Any) -> Roughness:
        read.append(patch)
        raise MeasurementError("no more is asked")

    monkeypatch.setattr("lscan.roughness.roughness_of", patch_alone)
    for window in ("32 64 0 80", "0 64 40 80"):
        part = ["--window", *window.split(), "--cell", "2"]
        said = CliRunner().invoke(app, ["roughness", str(tmp_path / "raised.nc"), *part])
        assert "no more is asked" in str(said.exception) and "steps" not in said.stderr
    assert [one.z_cm.shape for one in read] == [(40, 16), (20, 32)]
    far = ["--window", "70", "90", "0", "80"]
    said = CliRunner().invoke(app, ["roughness", str(tmp_path / "raised.nc"), *far])
    assert "--window" in str(said.exception) and "0 64 0 80" in str(said.exception)


def test_the_command_refuses_no_length_by_name(surface_file: Path) -> None:
    for option, value in (("--cell", "0"), ("--sheet", "-1"), ("--pixel", "nan"), ("--blur", "-1"),
                          ("--yaw", "80"),
                          ("--sediment", "snow"), ("--frequency", "-5")):  # fmt: skip
        said = CliRunner().invoke(app, ["roughness", str(surface_file), option, value])
        assert said.exit_code != 0
        assert isinstance(said.exception, InputError) and option[2:] in str(said.exception)


def test_a_surface_s_grid_is_a_patch_in_cm(surface_file: Path) -> None:
    grid = grid_cells(load_surface(surface_file), 2.0)
    one = patch_of(grid)
    assert one.cell_cm == pytest.approx(0.2)
    np.testing.assert_allclose(one.z_cm[one.seen], grid.z_mm[one.seen] / 10)
    assert one.noise_cm2 == pytest.approx((grid.sigma_z_mm[one.seen] ** 2).mean() / 100)


def test_profiles_are_a_patch_finer_than_cells(surface_file: Path) -> None:
    """Rows are the profiles, 0.5 mm apart.  A cubic stays one: its third differences are constant,
    across holes that are joined too."""
    surface = load_surface(surface_file)
    x = surface.xyz_mm[..., 0]
    cubic = np.concatenate([surface.xyz_mm[..., :2], (1e-4 * x**3)[..., np.newaxis]], axis=-1)
    one = patch_of_profiles(replace(surface, xyz_mm=cubic))
    assert one.cell_cm == pytest.approx(0.05) and one.z_cm.shape[0] == len(x)
    every = patch_of_profiles(surface, cell_mm=1.0)
    assert every.cell_cm == pytest.approx(0.1)
    third = np.diff(one.z_cm, 3, axis=1)
    kept = np.lib.stride_tricks.sliding_window_view(one.seen, 4, axis=1).all(axis=-1)
    assert kept.mean() > 0.3
    np.testing.assert_allclose(third[kept], 6e-4 * 0.5**3 / 10, rtol=1e-6)


def test_a_scan_backwards_shows_the_same_patch(surface_file: Path) -> None:
    """A heading from x towards y is the same whichever way the track went."""
    surface = load_surface(surface_file)
    arrays = ("xyz_mm", "sigma_x_mm", "sigma_z_mm", "status", "position_mm")
    back = replace(surface, **{name: getattr(surface, name)[::-1] for name in arrays})
    one, other = patch_of_profiles(surface), patch_of_profiles(back)
    np.testing.assert_allclose(other.z_cm, one.z_cm, atol=1e-12)
    assert (other.seen == one.seen).all()


def test_noise_of_points_that_are_joined_makes_no_slopes() -> None:
    """Points two cells apart share their noise with the cells between: what noise adds to the
    structure function is taken off to a quarter, of splines in place of straight lines."""
    x, y = np.meshgrid(np.arange(0.0, 80.0), np.arange(0.0, 40.0, 0.5))
    noise = np.random.default_rng(5).normal(0, 0.05, x.shape)
    status = np.full(x.shape, int(Status.OK))
    flat = Surface(np.stack([x, y, noise], -1), 0 * x, 0 * x + 0.05, status, y[:, 0], "workpiece")
    one = patch_of_profiles(flat)
    assert one.points_cells == pytest.approx(2.0)
    assert one.points_noise_cm2 == pytest.approx(0.005**2)
    for axis in (0, 1):
        left = structure_function(one, axis).difference_cm2
        assert np.abs(left).max() < 0.25 * 2 * one.points_noise_cm2


def test_bent_or_uneven_profiles_are_refused() -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    status = np.full(x.shape, int(Status.OK))
    flat = Surface(np.stack([x, y, 0 * x], -1), 0 * x, 0 * x + 0.1, status, y[:, 0], "head")
    assert patch_of_profiles(flat).z_cm.shape[0] == 30
    for change in (
        np.stack([0 * x, 0.01 * x**2, 0 * x], -1),
        np.stack([0 * x, 0.02 * y**2, 0 * x], -1),
    ):
        with pytest.raises(MeasurementError, match="give the side of a cell"):
            patch_of_profiles(replace(flat, xyz_mm=flat.xyz_mm + change))
    with pytest.raises(MeasurementError, match="16 are needed"):
        patch_of_profiles(replace(flat, status=np.where(y < 10, status, int(Status.NO_DATA))))


def test_profiles_of_a_bent_crest_share_a_wavelength() -> None:
    """Eq. (4) of the paper, in cm, with noise and holes: within 4 standard uncertainties."""
    y, x = (np.indices((60, 80)) + 0.5) * 0.2
    true = (0.15 + 0.043 * y) * np.sin(1.67 * x + 2 * np.sin(0.42 * y))
    rng = np.random.default_rng(4)
    seen = rng.random(x.shape) > 0.1
    found = profile_waves(patch(true + rng.normal(0, 0.01, x.shape), seen, 0.2))
    assert abs(found.wavelength_cm - 2 * np.pi / 1.67) < 4 * found.sigma_wavelength_cm
    off = found.amplitude_cm - (0.15 + 0.043 * y[:, 0])
    assert (np.abs(off) < 4 * found.sigma_amplitude_cm).all()
    turned = profile_waves(patch(true.T.copy(), seen.T.copy(), 0.2), axis=0)
    assert turned.wavelength_cm == pytest.approx(2 * np.pi / 1.67, rel=1e-6)
