"""The command ``lscan live``: a thin face over lscan.live."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.arguments import RigOrScene

if TYPE_CHECKING:
    from lscan.config.rigfile import RigFile
    from lscan.live.boardpicture import LiveCalibration


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
        str | None, typer.Option(help="What a browser must know; made where needed.")
    ] = None,
) -> None:
    """Serve a page with the picture, the line, the profile and the buttons of a scan."""
    from lscan.config.rigfile import load_rig
    from lscan.live.access import grant
    from lscan.live.server import listen, make_server
    from lscan.live.session import Session

    rig_file = load_rig(rig)
    used = _calibration(calibration, rig, rig_file) if calibration else None
    with listen(host, port) as listening:
        access = grant(host, listening.getsockname()[1], token)
        session = Session(rig_file, output, used)
        try:
            first, *others = access.addresses
            print(f"{first}  (Ctrl-C ends)", *others, sep="\n", flush=True)
            if access.token:
                print("everybody with this address can move the track", flush=True)
            make_server(session, access).run(sockets=[listening])
        finally:
            unfinished = session.close()
    if unfinished is not None:
        print(f"stopped; go on with: lscan scan {rig} -o {unfinished} --resume")


def _calibration(path: Path, rig: Path, rig_file: RigFile) -> LiveCalibration:
    """The calibration of a file; InputError where it is for pictures of another size."""
    from lscan.calibration.loading import load_plane_map
    from lscan.live.boardpicture import use_map
    from lscan.pipeline import require_size

    plane_map, size_px = load_plane_map(path)
    require_size(rig_file.rig.camera, size_px, path, rig)
    return use_map(path, plane_map, rig_file)
