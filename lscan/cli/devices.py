"""The command ``lscan devices``: a thin face over lscan.devices.listing and .trials."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.console import Json, print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.config.rig import RigFile
    from lscan.devices.api import Camera, Fact
    from lscan.devices.photontransfer import PhotonTransfer
    from lscan.devices.trials import CameraTrial, TrackTrial
    from lscan.records import Bytes


def devices(
    rig: Annotated[
        Path | None, typer.Argument(help="Rig file or scene file (TOML): what its devices can do.")
    ] = None,
    test: Annotated[
        bool, typer.Option("--test", help="Take pictures and move the track by 1 mm to and fro.")
    ] = False,
    dark: Annotated[
        bool, typer.Option("--dark", help="Ask for the cap on the lens, and measure the dark too.")
    ] = False,
    pictures: Annotated[int, typer.Option(min=4, help="Pictures at each exposure time.")] = 16,
    approaches: Annotated[
        int, typer.Option(min=2, help="Moves to one place from either side.")
    ] = 5,
    json: Json = False,
) -> None:
    """List cameras, serial ports and drivers; with --test, try out a rig's camera and track.

    For RIG it also lists what its devices can do, as known to their drivers without opening them.
    For --test show the camera a still, evenly lit scene with bright and dark parts, and keep the
    track's way clear by 2 mm, all of it where the track homes when it is opened.  The laser is
    switched on and off if the plan switches it.
    """
    from lscan.config.rig import load_rig
    from lscan.errors import InputError

    rig_file = None if rig is None else load_rig(rig)
    if not (test or dark):
        listing = _listing(rig_file)
        print_json(listing) if json else _print_listing(listing)
        return
    if rig_file is None:
        raise InputError("needs a rig file: lscan devices RIG --test", where="--test")
    camera, track = _try(rig_file, pictures, approaches, dark)
    if json:
        print_json(_trial_json(camera, track))
    else:
        _print_track(track)
        _print_camera(camera)


def _listing(rig_file: RigFile | None) -> dict[str, Any]:
    from lscan.devices.listing import drivers, rig_devices, serial_ports, video_devices

    listing = {"cameras": video_devices(), "serial_ports": serial_ports(), "drivers": drivers()}
    return listing if rig_file is None else {**listing, "rig": rig_devices(rig_file)}


def _print_listing(listing: dict[str, Any]) -> None:
    if listing["cameras"]:
        rows = [
            [
                camera.device,
                camera.state,
                _size(camera.size_px),
                camera.pixel_format or "",
                ", ".join(map(_size, camera.sizes_px)),
            ]
            for camera in listing["cameras"]
        ]
        print_table("cameras", ["device", "state", "now", "format", "sizes"], rows)
        for name, camera in sorted((n, each) for each in listing["cameras"] for n in each.by_id):
            print(f"{camera.device} is also {name}, whatever its number becomes")
    else:
        print("cameras: none found")
    ports = listing["serial_ports"]
    if ports:
        rows = [[port.device, port.description] for port in ports]
        print_table("serial ports", ["device", "what it says of itself"], rows)
    else:
        print("serial ports: " + ("none found" if ports == [] else "not listed, no pyserial here"))
    rows = [[driver.name, driver.kind, driver.does] for driver in listing["drivers"]]
    print_table("drivers", ["name", "of a", "what it drives"], rows)
    for kind, facts in listing.get("rig", {}).items():
        _print_facts(f"the rig's {kind}", facts)


def _size(size_px: tuple[int, int] | None) -> str:
    return "" if size_px is None else f"{size_px[0]}x{size_px[1]}"


def _try(
    rig_file: RigFile, pictures: int, approaches: int, dark: bool
) -> tuple[CameraTrial, TrackTrial]:
    """Open the rig's devices and try them out; the cap first, where the dark is wanted."""
    from lscan.acquisition.scan import open_devices
    from lscan.devices.api import LaserSwitch
    from lscan.devices.trials import try_camera, try_track

    channel = rig_file.rig.stripe.colour
    dark_pictures = _dark_pictures(rig_file, pictures) if dark else None
    with open_devices(rig_file) as (camera, track):
        # The track first: what is wrong with it is known before the many pictures are taken.
        with progress_bar("moves") as report:
            moved = try_track(track, approaches, progress=report)
        may_light = rig_file.rig.plan.laser != "untouched"
        laser = track if may_light and isinstance(track, LaserSwitch) else None
        with progress_bar("pictures") as report:
            return try_camera(camera, pictures, channel, dark_pictures, report, laser), moved


def _dark_pictures(rig_file: RigFile, pictures: int) -> Bytes:
    """Pictures taken with the cap on; the prompts are on stderr, since stdout may be for JSON."""
    from lscan.acquisition.scan import open_devices
    from lscan.devices.trials import BlackAccepting, grab_series

    ask = partial(typer.prompt, default="", show_default=False, err=True)
    ask("put the cap on the lens, then press Enter")
    with open_devices(rig_file) as (camera, _):
        opened: Camera = camera
        if isinstance(opened, BlackAccepting):
            opened.accept_black()
        series, _ = grab_series(camera, pictures, rig_file.rig.stripe.colour)
    ask("take the cap off, then press Enter")
    return series


def _trial_json(camera: CameraTrial, track: TrackTrial) -> dict[str, Any]:
    content = {**asdict(camera), "rig_section": camera.noise_section}
    content["settings"] = [{**asdict(each), "obeyed": each.obeyed} for each in camera.settings]
    if camera.transfer is not None:
        content["transfer"]["read_is_rounding"] = camera.transfer.read_is_rounding
    return {"camera": content, "track": track}


def _print_track(trial: TrackTrial) -> None:
    if trial.facts:
        _print_facts("the track says", trial.facts)
    found = trial.repeatability
    longest_s = max(move.time_s for move in trial.moves)
    print_table(
        f"track at {found.place_mm:g} mm, {found.approaches} approaches from either side",
        ["position as it reports it", "mm"],
        [
            ["mean, less what was asked", f"{found.deviation_mm:.4f}"],
            ["standard deviation after approaches from below", f"{found.upward_sigma_mm:.4f}"],
            ["standard deviation after approaches from above", f"{found.downward_sigma_mm:.4f}"],
            ["mean from below, less mean from above", f"{found.reversal_mm:.4f}"],
        ],
    )
    print(
        f"{len(trial.moves)} moves, the longest took {longest_s:.2f} s; steps that a motor lost "
        "show only on a scale"
    )


def _print_camera(camera: CameraTrial) -> None:
    if camera.settings:
        rows = [
            [
                setting.name,
                setting.asked,
                "nothing" if setting.got is None else setting.got,
                "yes" if setting.obeyed else "no",
            ]
            for setting in camera.settings
        ]
        print_table("camera settings", ["setting", "asked", "reported", "obeyed"], rows)
    timing = camera.timing
    print(
        f"timing: {timing.rate_hz:.2f} pictures/s, jitter {timing.jitter_ms:.2f} ms, "
        f"latency {timing.latency_ms:.1f} ms"
    )
    if camera.delay is not None:
        print(
            f"delay: the laser's switching is shown after {camera.delay.longest_ms:.0f} ms at most "
            f"(median {camera.delay.median_ms:.0f} of {camera.delay.switches}); no older picture "
            f"is taken with camera.options.flush_ms = {camera.delay.flush_ms}, which has the "
            "longest time between two pictures for a margin"
        )
    if camera.dark_dn is not None:
        print(f"dark: {camera.dark_dn:.2f} DN, noise {camera.dark_noise_dn:.3f} DN")
    if camera.linearity is not None:
        print(f"linearity: error {camera.linearity.error_percent:.2f} % (5 to 95 % of the range)")
    for remark in camera.remarks:
        print(remark)
    if camera.transfer is not None:
        _print_noise(camera.transfer)
    for doubt in camera.doubts:
        print(doubt)
    section = camera.noise_section
    print(f"\nfor the rig file:\n\n{section}" if section else "no [stripe.noise] to rely on")


def _print_noise(transfer: PhotonTransfer) -> None:
    read = f"{transfer.read_dn:.3f} ± {transfer.read_sigma_dn:.3f} DN"
    if transfer.read_is_rounding:
        # The noise of rounding is a floor, not a figure of this camera.
        read = f"at most {transfer.read_at_most_dn:.3f} DN (rounding makes {transfer.read_dn:.3f})"
    print(
        f"photon transfer: read noise {read}, "
        f"gain {transfer.dn_per_electron:.4f} ± {transfer.gain_sigma:.4f} DN per electron, "
        f"chi² {transfer.chi2:.2f} per degree of freedom (about 1 for a linear camera)"
    )


def _print_facts(title: str, facts: dict[str, Fact]) -> None:
    print_table(title, ["", ""], [[name, _in_words(fact)] for name, fact in facts.items()])


def _in_words(fact: Fact) -> str:
    if fact is None or isinstance(fact, bool):
        return {True: "yes", False: "no", None: "unknown"}[fact]
    return fact if isinstance(fact, str) else f"{fact:.6g}"
