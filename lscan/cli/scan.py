"""``lscan scan``, ``live`` and ``scenes``: what is scanned, from a terminal or a browser."""

from contextlib import nullcontext
from pathlib import Path

from typer import Argument, Option

from lscan.acquisition.scan import scan as write_run
from lscan.acquisition.writer import holds_no_run
from lscan.cli.console import Json, keep_notes_when_stopped, note, progress_bar, show
from lscan.config.rig import load_rig
from lscan.config.scenes import copy_scenes, scene_about, scene_names
from lscan.config.userfiles import name_schemas
from lscan.errors import DeviceError, InputError


def scan(
    rig: Path = Argument(help="Rig file or scene file (TOML), or a scene's name."),
    output: Path = Option(..., "--output", "-o", help="Run folder to write."),
    resume: bool = Option(False, "--resume", help="Resume a stopped run."),
    position_restored: bool = Option(
        False,
        "--position-restored",
        help="With --resume after the track lost its zero: the head was put back by hand.",
    ),
    json: Json = False,
) -> None:
    """Move the track, take the pictures, write a run folder."""
    if position_restored and not resume:
        raise InputError("goes with --resume only", where="--position-restored")
    rig_file = load_rig(rig)
    if resume and holds_no_run(output):
        note(f"there is nothing to resume in {output}; a new run is begun")
    with keep_notes_when_stopped(), progress_bar("scan") as progress:
        run = write_run(
            rig_file, output, resume=resume, position_restored=position_restored, progress=progress
        )
    words = f"{len(run)} {'frame' if len(run) == 1 else 'frames'} in {run.path}"
    show({"run": run.path, "frames": len(run), "state": run.state}, words, json=json)


def live(
    rig: Path = Argument(help="Rig file or scene file (TOML), or a scene's name."),
    calibration: Path | None = Option(None, "--calibration", "-c", help="Calibration file (JSON)."),
    output: Path = Option(Path("runs"), "--output", "-o", help="Folder for the run folders."),
    host: str = Option("127.0.0.1", help="Address to serve on."),
    port: int = Option(8765, min=0, max=65535, help="Port; 0 for any that is free."),
    token: str | None = Option(
        None, help="Token that a browser must present; generated if others can reach --host."
    ),
    mcap: Path | None = Option(
        None, help="Recording (.mcap) of what is looked at: pictures, positions, points."
    ),
) -> None:
    """Serve a page with the picture, the line, the profile and the buttons of a scan."""
    # Here: a web server takes as long to load as all the rest, and ``lscan scan`` needs none.
    from lscan.calibration.calibrationfile import load_plane_map
    from lscan.cli.inputs import require_mcap
    from lscan.devices.signals import no_suspending, on_stop_signals
    from lscan.files.rosmessages import message_file
    from lscan.live.scanning import use_map
    from lscan.live.server import grant, listen, make_server
    from lscan.live.session import Session
    from lscan.pipeline import require_size
    from lscan.surface.recording import LiveRecording

    if mcap is not None:
        require_mcap("--mcap", mcap)
    rig_file, used = load_rig(rig), None
    if calibration is not None:
        plane_map, size_px = load_plane_map(calibration)
        require_size(rig_file.rig.camera, size_px, calibration, rig)
        used = use_map(calibration, plane_map, rig_file)
    session: Session | None = None
    try:
        with (
            listen(host, port) as listening,
            message_file(mcap) if mcap is not None else nullcontext() as file,
        ):
            access = grant(host, listening.getsockname()[1], token)
            recording = LiveRecording(file, rig_file.rig) if file is not None else None
            session = Session(rig_file, output, used, recording)
            server = make_server(session, access)
            # Whatever signals come, and however many: the laser is off before the program ends.
            with on_stop_signals(server.stop), no_suspending():
                try:
                    first, *others = access.addresses
                    print(f"{first}  (Ctrl-C ends)", *others, sep="\n", flush=True)
                    print(access.remark, flush=True)
                    server.run(sockets=[listening])
                finally:
                    unfinished = session.close()
            if unfinished is not None:
                go_on = f"lscan scan {rig} -o {unfinished} --resume"
                print(f"stopped; go on with: {go_on}", flush=True)
            if session.recording_fault:
                note(session.recording_fault)
    finally:  # also where the recording cannot be ended
        if session is not None and session.laser_warning:
            raise DeviceError(session.laser_warning)


def scenes(
    copy: Path | None = Option(None, help="New folder to copy all scenes to."),
    json: Json = False,
) -> None:
    """List the scenes, rigs and boards that come with lscan, or copy them to be edited.

    Each copy names its JSON schema in its first line, by which editors complete and check it.
    """
    names = scene_names()
    if copy is None:
        words = [f"{name:26}{scene_about(name)}" for name in names]
    else:
        copy_scenes(copy)
        name_schemas(copy)
        words = [f"{len(names)} scenes, rigs and boards in {copy}"]
    show({"scenes": names, "copied_to": copy}, *words, json=json)
