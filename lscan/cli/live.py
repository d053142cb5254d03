"""The command ``lscan live``: a thin face over lscan.live."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import RigOrScene


def live(
    rig: RigOrScene,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", "-c", help="Calibration file (JSON).")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the run folders.")
    ] = Path("runs"),
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0: any that is free.")] = 8765,
    token: Annotated[
        str | None,
        typer.Option(help="What a browser must know; made for a --host that others reach."),
    ] = None,
) -> None:
    """Serve a page with the picture, the line, the profile and the buttons of a scan."""
    from lscan.calibration.calibrationfile import load_plane_map
    from lscan.config.rig import load_rig
    from lscan.devices.signals import no_suspending, on_stop_signals
    from lscan.errors import DeviceError
    from lscan.live.scanning import use_map
    from lscan.live.server import grant, listen, make_server
    from lscan.live.session import Session
    from lscan.pipeline import require_size

    rig_file, used = load_rig(rig), None
    if calibration is not None:
        plane_map, size_px = load_plane_map(calibration)
        require_size(rig_file.rig.camera, size_px, calibration, rig)
        used = use_map(calibration, plane_map, rig_file)
    with listen(host, port) as listening:
        access = grant(host, listening.getsockname()[1], token)
        session = Session(rig_file, output, used)
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
                print(f"stopped; go on with: lscan scan {rig} -o {unfinished} --resume", flush=True)
    if session.laser_warning:
        raise DeviceError(session.laser_warning)
