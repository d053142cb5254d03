"""``lscan devices``, a thin face over lscan.devices.listing and .trials, and ``lscan init``."""

import os
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table
from typer import Argument, Option

from lscan.acquisition.scan import open_devices
from lscan.cli.console import Json, one_of, progress_bar, require_folders, show, table
from lscan.cli.inputs import parse_numbers
from lscan.config.documents import toml_text
from lscan.config.rig import RigFile, checked_rig, load_rig
from lscan.config.scenes import scene_file
from lscan.config.userfiles import SCHEMAS, json_schema
from lscan.devices.api import Fact, LaserSwitch
from lscan.devices.genicam import found_cameras
from lscan.devices.listing import drivers, rig_devices, serial_ports, video_devices
from lscan.devices.photontransfer import PhotonTransfer
from lscan.devices.trials import (
    BlackAccepting,
    CameraTrial,
    TrackTrial,
    grab_series,
    try_camera,
    try_track,
)
from lscan.errors import InputError
from lscan.files.disk import json_text, make_folder, read_text, write_atomically
from lscan.records import plus_minus


def devices(
    rig: Path | None = Argument(
        None, help="Rig file or scene file (TOML) whose devices are described or tried out."
    ),
    test: bool = Option(
        False, "--test", help="Take pictures, and move the track back and forth by 1 mm."
    ),
    dark: bool = Option(
        False, "--dark", help="Measure dark pictures as well; asks you to put the cap on the lens."
    ),
    pictures: int = Option(16, min=4, help="Pictures at each exposure time."),
    approaches: int = Option(5, min=2, help="Moves to the same place from each side."),
    json: Json = False,
) -> None:
    """List cameras, serial ports and drivers; with --test, try out a rig's camera and track.

    With RIG, also list what its devices can do, as far as their drivers know without opening them.
    For --test, show the camera a still, evenly lit scene with bright and dark parts, and keep 2 mm
    of the track's way clear, or all of it if the track homes when it is opened.  The laser is
    switched on and off if the plan switches it.
    """
    rig_file = None if rig is None else load_rig(rig)
    if not (test or dark):
        listing: dict[str, Any] = {
            "cameras": video_devices(), "genicam_cameras": found_cameras(),
            "serial_ports": serial_ports(), "drivers": drivers(),
        }  # fmt: skip
        if rig_file is not None:
            listing["rig"] = rig_devices(rig_file)
        show(listing, *_listing_lines(listing), json=json)
        return
    if rig_file is None:
        raise InputError("needs a rig file: lscan devices RIG --test", where="--test")
    camera, track = _try_devices(rig_file, pictures, approaches, dark)
    content = {"camera": _camera_json(camera), "track": track}
    show(content, *_track_lines(track), *_camera_lines(camera), json=json)


def _listing_lines(listing: dict[str, Any]) -> Iterator[str | Table]:
    if listing["cameras"]:
        rows = [
            [one.device, one.state, _size(one.size_px), one.pixel_format or "",
             ", ".join(map(_size, one.sizes_px))]
            for one in listing["cameras"]
        ]  # fmt: skip
        yield table("cameras", ["device", "state", "now", "format", "sizes"], rows)
        for name, camera in sorted((n, each) for each in listing["cameras"] for n in each.by_id):
            yield f"{camera.device} is also {name}, whatever its number becomes"
    else:
        yield "cameras: none found"
    if industrial := listing.get("genicam_cameras"):
        rows = [[name, model] for name, model in industrial.items()]
        yield table("GenICam cameras", ["address or serial", "maker and model"], rows)
    if ports := listing["serial_ports"]:
        rows = [[port.device, port.description] for port in ports]
        yield table("serial ports", ["device", "description"], rows)
    else:
        yield "serial ports: " + ("none found" if ports == [] else "not listed, no pyserial here")
    if listing["drivers"]:
        rows = [[driver.name, driver.kind, driver.does] for driver in listing["drivers"]]
        yield table("drivers", ["name", "kind", "what it drives"], rows)
    for kind, facts in listing.get("rig", {}).items():
        yield _facts_table(f"the rig's {kind}", facts)


def _size(size_px: tuple[int, int] | None) -> str:
    return "" if size_px is None else f"{size_px[0]}x{size_px[1]}"


def _try_devices(
    rig_file: RigFile, pictures: int, approaches: int, dark: bool
) -> tuple[CameraTrial, TrackTrial]:
    """Open the rig's devices and try them out; the cap first, where the dark is wanted."""
    stripe, dark_pictures = rig_file.rig.stripe, None
    if dark:
        # The prompts are on stderr, since stdout may be for JSON.
        ask = partial(typer.prompt, default="", show_default=False, err=True)
        ask("put the cap on the lens, then press Enter")
        with open_devices(rig_file) as (camera, _):
            if isinstance(camera, BlackAccepting):
                camera.accept_black()
            dark_pictures, _ = grab_series(camera, pictures, stripe.colour, gamma=stripe.gamma)
        ask("take the cap off, then press Enter")
    with open_devices(rig_file) as (camera, track):
        # The track first: what is wrong with it is known before the many pictures are taken.
        with progress_bar("moves") as report:
            track_trial = try_track(track, approaches, progress=report)
        may_light = rig_file.rig.plan.laser != "untouched"
        laser = track if may_light and isinstance(track, LaserSwitch) else None
        with progress_bar("pictures") as report:
            trial = try_camera(
                camera, pictures, stripe.colour, dark_pictures, report, laser, stripe.gamma
            )
    return trial, track_trial


def _camera_json(trial: CameraTrial) -> dict[str, Any]:
    """What a camera showed, as --json prints it."""
    content = {**asdict(trial), "rig_section": trial.noise_section}
    content["settings"] = [{**asdict(each), "obeyed": each.obeyed} for each in trial.settings]
    if trial.transfer is not None:
        content["transfer"]["read_is_rounding"] = trial.transfer.read_is_rounding
    return content


def _track_lines(trial: TrackTrial) -> Iterator[str | Table]:
    if trial.facts:
        yield _facts_table("the track says", trial.facts)
    found = trial.repeatability
    longest_s = max(move.time_s for move in trial.moves)
    yield table(
        f"track at {found.place_mm:g} mm, {found.approaches} approaches from either side",
        ["reported position", "mm"],
        [
            ["mean, less what was asked", f"{found.deviation_mm:.4f}"],
            ["standard deviation after approaches from below", f"{found.upward_sigma_mm:.4f}"],
            ["standard deviation after approaches from above", f"{found.downward_sigma_mm:.4f}"],
            ["mean from below, less mean from above", f"{found.reversal_mm:.4f}"],
        ],
    )
    yield (
        f"{len(trial.moves)} moves, the longest took {longest_s:.2f} s; steps that the motor lost "
        "can be seen on a scale only"
    )


def _camera_lines(camera: CameraTrial) -> Iterator[str | Table]:
    """What a camera showed, for ``show``."""
    if camera.settings:
        rows = [
            [one.name, one.asked, "nothing" if one.got is None else one.got,
             "yes" if one.obeyed else "no"]
            for one in camera.settings
        ]  # fmt: skip
        yield table("camera settings", ["setting", "asked", "reported", "obeyed"], rows)
    timing = camera.timing
    yield (
        f"timing: {timing.rate_hz:.2f} pictures/s, jitter {timing.jitter_ms:.2f} ms, "
        f"latency {timing.latency_ms:.1f} ms"
    )
    if camera.delay is not None:
        yield (
            f"delay: pictures show the laser's switching after {camera.delay.longest_ms:.0f} ms at "
            f"most (median {camera.delay.median_ms:.0f} of {camera.delay.switches}); with "
            f"camera.options.flush_ms = {camera.delay.flush_ms}, which includes the longest time "
            "between two pictures as a margin, no older picture is taken"
        )
    if camera.dark_dn is not None:
        yield f"dark: {camera.dark_dn:.2f} DN, noise {camera.dark_noise_dn:.3f} DN"
    if camera.linearity is not None:
        yield f"linearity: error {camera.linearity.error_percent:.2f} % (5 to 95 % of the range)"
        if camera.linearity.is_curved:
            gamma, sigma = camera.linearity.gamma, camera.linearity.gamma_sigma
            yield (
                f"its grey values follow a curve of gamma {gamma:.2f} ± {sigma:.2f}: state "
                f"gamma = {gamma:.2g} under [stripe], or switch the curve off in the camera, and "
                "try again; as it is, the line ends too late at edges"
            )
    yield from camera.remarks
    if camera.transfer is not None:
        yield _transfer_line(camera.transfer)
    yield from camera.doubts
    section = camera.noise_section
    yield f"\nfor the rig file:\n\n{section}" if section else "no [stripe.noise] to rely on"


def _transfer_line(transfer: PhotonTransfer) -> str:
    """What the photon transfer of a camera is, in words."""
    read = plus_minus(transfer.read_dn, transfer.read_sigma_dn, "DN")
    if transfer.read_is_rounding:
        # The noise of rounding is a floor, not a figure of this camera.
        read = f"at most {transfer.read_at_most_dn:.3f} DN (rounding makes {transfer.read_dn:.3f})"
    return (
        f"photon transfer: read noise {read}, "
        f"gain {plus_minus(transfer.dn_per_electron, transfer.gain_sigma)} DN per electron, "
        f"chi² {transfer.chi2:.2f} per degree of freedom (about 1 for a linear camera)"
    )


def _facts_table(title: str, facts: dict[str, Fact]) -> Table:
    return table(title, ["", ""], [[name, _in_words(fact)] for name, fact in facts.items()])


def _in_words(fact: Fact) -> str:
    if fact is None or isinstance(fact, bool):
        return {True: "yes", False: "no", None: "unknown"}[fact]
    return fact if isinstance(fact, str) else f"{fact:.6g}"


# A rig file for the devices that are found.


QUESTIONS = {
    "camera": "camera: its number, path or address",
    "track": "track: its serial port, or manual",
    "scan": "scan: STEP,LENGTH in mm",
    "board": "board: a file, the name of one that comes with lscan, or none",
    "water": "what is before the camera: fresh or sea water behind a window, or air",
}
"""What ``lscan init`` asks, by the option that answers it."""
MY_BOARD = "my-board.toml"
_WINDOW = """\
# The window: air before the glass and the glass itself, each with its standard uncertainty.
gap_mm = [10.0, 5.0]
thickness_mm = [5.0, 3.0]
# The water, likewise.
"""
_OPTICS = {
    "fresh": f"{_WINDOW}temperature_c = [20.0, 5.0]",
    "sea": f"{_WINDOW}temperature_c = [15.0, 5.0]\nsalinity_psu = [35.0, 2.0]",
    "air": 'port = "none"',
}
_RIG = """\
#:schema ./{schemas}/rig.json
# A rig, as `lscan scan`, `live` and `devices` take it.  All keys: lscan schema rig --text

name = "my scanner"

[camera]
driver = "opencv"
width_px = {size_px[0]}
height_px = {size_px[1]}
exposure_ms = 20
# State gain, focus and white_balance too: what changes by itself changes the line.
options = {{ {camera} }}

[track]
{track}

[plan]
start_mm = 0
step_mm = {step_mm:g}
frames = {frames}
# "on": the controller lights the laser for the scan; "pairs": each picture is taken without, too.
laser = "untouched"

[optics]
{optics}

# A webcam's tone curve, about 2.2, is found by: lscan devices RIG --test
# [stripe]
# gamma = 2.2
"""
_BOARD = """
[board]
file = {file}
"""
_GRBL = """\
driver = "grbl"
# zero_mm: where the machine's own coordinate, 0 at the switches, has the position 0.
options = {{ port = {port}, min_mm = 0, max_mm = {length_mm:g}, zero_mm = {zero_mm:g} }}"""
_MANUAL = """\
driver = "manual"
options = {{ min_mm = 0, max_mm = {length_mm:g} }}"""


def init(
    output: Path = Argument(Path("rig.toml"), help="Rig file to write."),
    camera: str | None = Option(None, help="Number, path or address of the camera."),
    track: str | None = Option(None, help="Serial port of the track, or manual."),
    scan: str | None = Option(None, help="Step and length of the scan: STEP,LENGTH in mm."),
    board: str | None = Option(
        None, help="Board file, name of one that comes with lscan, which is copied, or none."
    ),
    water: str | None = Option(None, help="What is before the camera: fresh, sea or air."),
    yes: bool = Option(False, "--yes", help="Ask nothing: take what would be proposed."),
    force: bool = Option(False, "--force", help="Replace files that are there."),
    json: Json = False,
) -> None:
    """Ask five questions, and write a rig file for the camera and the track."""
    require_folders(output)
    _require_new([output], force)
    cameras, ports = video_devices(), serial_ports()
    if not yes:
        for line in _listing_lines({"cameras": cameras, "serial_ports": ports, "drivers": []}):
            Console(stderr=True, markup=False).print(line)
    ready = {
        name: one.size_px
        for one in cameras
        for name in (*one.by_id, str(one.device))
        if one.state == "ready"
    }
    my_board = output.with_name(MY_BOARD)
    usual = {
        "camera": next(iter(ready), "0"),
        # A port without a description is one of the board's own, with nothing behind it.
        "track": next((one.device for one in ports or () if one.description != "n/a"), "manual"),
        "scan": "0.5,150",
        "board": str(my_board) if my_board.is_file() else "paper/calibration-board",
        "water": "fresh",
    }
    given = {"camera": camera, "track": track, "scan": scan, "board": board, "water": water}
    answers = {
        name: given[name] or (usual[name] if yes else typer.prompt(asked, usual[name], err=True))
        for name, asked in QUESTIONS.items()
    }
    folder = output.parent / SCHEMAS
    files, text = dict[Path, str](), _rig_text(answers, ready.get(answers["camera"]))
    document = tomllib.loads(text)
    if answers["board"] != "none":
        plate = source = scene_file(answers["board"])
        if source != Path(answers["board"]):  # one of lscan's, to be changed to the plate there is
            plate = my_board
            files[plate] = f"#:schema ./{SCHEMAS}/board.json\n{read_text(source)}"
        text += _BOARD.format(file=_quoted(os.path.relpath(plate, output.parent)))
        document["board"] = {"file": str(source)}
    checked_rig(document, source=str(output))
    files[output] = text
    _require_new(files, force)
    make_folder(folder)
    for kind in ("rig", "board"):
        if force or not os.path.lexists(folder / f"{kind}.json"):
            files[folder / f"{kind}.json"] = f"{json_text(json_schema(kind))}\n"
    for file, content in files.items():
        write_atomically(file, content.encode())
    next_steps = [
        f"lscan devices {output} --test: tries the camera and the track out",
        f"lscan live {output}: align, focus and expose, place the board, and scan",
    ]
    words = f"{', '.join(map(str, files))}: written; state there what is known of window and water"
    show({"files": list(files), **answers}, words, *next_steps, json=json)


def _require_new(files: Iterable[Path], force: bool) -> None:
    for file in files:
        if os.path.lexists(file) and not force:
            raise InputError("is there already", where=file, allowed="a new file, or --force")


def _rig_text(answers: dict[str, str], size_px: tuple[int, int] | None) -> str:
    """The rig file, without its board, of a camera of that size where it is known."""
    one_of(answers["water"], _OPTICS, "--water")
    numbers = parse_numbers(answers["scan"], 2)
    if numbers is None or not (numbers[0] > 0 and numbers[1] >= 0):
        allowed = "STEP,LENGTH in mm, such as 0.5,150"
        raise InputError("is no scan", where="--scan", value=answers["scan"], allowed=allowed)
    (step_mm, length_mm), camera, port = numbers, answers["camera"], answers["track"]
    key = "url" if "://" in camera else "device"
    track = _MANUAL if port == "manual" else _GRBL
    return _RIG.format(
        schemas=SCHEMAS,
        size_px=size_px or (640, 480),
        camera=f"{key} = {int(camera) if camera.isdecimal() else _quoted(camera)}",
        track=track.format(port=_quoted(port), length_mm=length_mm, zero_mm=-(length_mm + 10)),
        step_mm=step_mm,
        frames=int(length_mm / step_mm + 1e-9) + 1,
        optics=_OPTICS[answers["water"]],
    )


def _quoted(text: str) -> str:
    """A text in TOML."""
    return toml_text({"_": text}).partition(" = ")[2].strip()
