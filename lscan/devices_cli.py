"""The command ``lscan devices``: a thin face over lscan.devices.listing and .trial."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.console import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.devices.api import Camera
    from lscan.devices.trial import CameraTrial, Move
    from lscan.records import Bytes
    from lscan.rig import RigFile


def devices(
    rig: Annotated[
        Path | None, typer.Argument(help="Rig file or scene file (TOML); for --test.")
    ] = None,
    test: Annotated[
        bool, typer.Option("--test", help="Take pictures and move the track by 1 mm and back.")
    ] = False,
    dark: Annotated[
        bool, typer.Option("--dark", help="Ask for the cap on the lens, and measure the dark too.")
    ] = False,
    pictures: Annotated[
        int, typer.Option("--pictures", min=4, help="Pictures at each exposure time.")
    ] = 16,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """List cameras, serial ports and drivers; with --test, try out a rig's camera and track."""
    from lscan.errors import InputError
    from lscan.rig import load_rig

    if (test or dark) and rig is None:
        raise InputError("needs a rig file: lscan devices RIG --test", where="--test")
    if rig is not None and (test or dark):
        rig_file = load_rig(rig)
        camera, moves = _try(rig_file, pictures, dark)
        if json:
            print_json(_trial_json(camera, moves))
        else:
            _print_trial(camera, moves)
        return
    listing = _listing()
    if rig is not None:
        listing["rig"] = _of_rig(load_rig(rig))
    if json:
        print_json(listing)
    else:
        _print_listing(listing)


def _listing() -> dict[str, Any]:
    from lscan.devices.listing import drivers, serial_ports, video_devices

    ports = serial_ports()
    return {
        "cameras": [asdict(device) for device in video_devices()],
        "serial_ports": None if ports is None else [asdict(port) for port in ports],
        "drivers": [asdict(driver) for driver in drivers()],
    }


def _of_rig(rig_file: RigFile) -> dict[str, str]:
    """Which drivers a rig names."""
    return {"camera": rig_file.rig.camera.driver, "track": rig_file.rig.track.driver}


def _print_listing(listing: dict[str, Any]) -> None:
    cameras = [
        [
            device["device"],
            device["state"],
            _size(device["size_px"]),
            device["pixel_format"] or "",
            ", ".join(map(_size, device["sizes_px"])),
        ]
        for device in listing["cameras"]
    ]
    if cameras:
        print_table("cameras", ["", "", "now", "format", "sizes"], cameras)
    else:
        print("cameras: none found")
    ports = listing["serial_ports"]
    if ports:
        print_table("serial ports", ["", ""], [[*port.values()] for port in ports])
    else:
        print("serial ports: " + ("none found" if ports == [] else "not listed, no pyserial here"))
    rows = [[driver["name"], driver["kind"], driver["does"]] for driver in listing["drivers"]]
    print_table("drivers", ["", "of a", ""], rows)
    for kind, driver in listing.get("rig", {}).items():
        print(f"the rig's {kind}: driver {driver!r}")


def _size(size_px: tuple[int, int] | None) -> str:
    return "" if size_px is None else f"{size_px[0]}x{size_px[1]}"


def _try(rig_file: RigFile, pictures: int, dark: bool) -> tuple[CameraTrial, list[Move]]:
    """Open the rig's devices and try them out; the cap first, where the dark is wanted."""
    from lscan.acquire import open_devices
    from lscan.devices.trial import try_camera, try_track

    channel = rig_file.rig.stripe.channel
    if dark:
        # On stderr: stdout is for the result, which may be JSON.
        typer.prompt("put the cap on the lens, then press Enter", "", show_default=False, err=True)
        dark_pictures = _dark_pictures(rig_file, pictures)
        typer.prompt("take the cap off, then press Enter", "", show_default=False, err=True)
    else:
        dark_pictures = None
    with open_devices(rig_file) as (camera, track), progress_bar("pictures") as report:
        return try_camera(camera, pictures, channel, dark_pictures, report), try_track(track)


def _dark_pictures(rig_file: RigFile, pictures: int) -> Bytes:
    from lscan.acquire import open_devices
    from lscan.devices.trial import BlackAccepting, grab_series

    with open_devices(rig_file) as (camera, _):
        opened: Camera = camera
        if isinstance(opened, BlackAccepting):
            opened.accept_black()
        series, _ = grab_series(camera, pictures, rig_file.rig.stripe.channel)
    return series


def _trial_json(camera: CameraTrial, moves: list[Move]) -> dict[str, Any]:
    from lscan.devices.trial import noise_section

    transfer = camera.transfer
    content = asdict(camera)
    if transfer is not None:
        content["transfer"]["levels"] = {
            name: array.tolist() for name, array in content["transfer"]["levels"].items()
        }
        content["rig_section"] = noise_section(transfer)
    return {"camera": content, "track": [asdict(move) for move in moves]}


def _print_trial(camera: CameraTrial, moves: list[Move]) -> None:
    from lscan.devices.trial import noise_section

    timing = camera.timing
    print(
        f"timing: {timing.rate_hz:.2f} pictures/s, jitter {timing.jitter_ms:.2f} ms, "
        f"latency {timing.latency_ms:.1f} ms"
    )
    if camera.dark_dn is not None:
        print(f"dark: {camera.dark_dn:.2f} DN, noise {camera.dark_noise_dn:.3f} DN")
    if camera.linearity is not None:
        print(f"linearity: error {camera.linearity.error_percent:.2f} % (5 to 95 % of the range)")
    rows = [[f"to {move.commanded_mm:g} mm", move.reported_mm, move.time_s] for move in moves]
    print_table("track", ["", "reported mm", "s"], rows)
    for remark in camera.remarks:
        print(remark)
    transfer = camera.transfer
    if transfer is not None:
        print(
            f"photon transfer: read noise {transfer.read_dn:.3f} ± {transfer.read_sigma_dn:.3f} DN,"
            f" gain {transfer.dn_per_electron:.4f} ± {transfer.gain_sigma:.4f} DN per electron, "
            f"chi² {transfer.chi2:.2f} per degree of freedom (about 1 for a linear camera)"
        )
        print(f"\nfor the rig file:\n\n{noise_section(transfer)}")
