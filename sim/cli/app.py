"""The command line ``lscan-sim``: the tank's commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.console import print_json, print_table, progress_bar, run_command_line
from lscan.cli.summaries import print_chains
from lscan.config.scenes import scenes_folder
from lscan.errors import InputError

if TYPE_CHECKING:
    from sim.datasets.files import Taken
    from sim.scene import Scene
    from sim.validation.rows import Row

app = typer.Typer(
    help="The tank in software: demo, render, truth, views, verify, serve.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

SceneFile = Annotated[
    Path, typer.Argument(help="Scene file (TOML), or a name that `lscan scenes` lists.")
]
Position = Annotated[
    float | None, typer.Option("--position", help="Track position, mm; the plan's start.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
ScenesFolder = Annotated[
    Path | None, typer.Option("--scenes", help="Folder of scene files, if not those of lscan.")
]
PaperFolder = Annotated[
    Path | None,
    typer.Option("--scenes", help="Folder with board, groove and sandwave, if not the paper's."),
]
Quick = Annotated[
    bool, typer.Option("--quick", help="Every figure with the least effort, within a minute.")
]


@app.command()
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path(
        "out/demo"
    ),
    scenes: PaperFolder = None,
    frames: Annotated[
        int | None, typer.Option("--frames", min=100, help="Sandwave pictures, if not 400.")
    ] = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """The paper's experiment: calibrate, scan, measure and compare, with a report."""
    from sim.demo import run_demo

    results = run_demo(scenes or scenes_folder() / "paper", output, frames, quick=quick)
    if json:
        print_json(results)
        return
    _print_summary(results)
    print(f"{output / 'report.html'}\n{output / 'results.json'}")


@app.command()
def render(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    position: Position = None,
    samples: Annotated[
        int | None, typer.Option("--samples", min=1, help="Samples a pixel, a square number.")
    ] = None,
    json: Json = False,
) -> None:
    """The picture the webcam would take, and the layers of light it is made of."""
    from sim.datasets.files import write_render
    from sim.devices import load_checked

    loaded = load_checked(scene)
    place = loaded.rig.plan.start_mm if position is None else position
    files = write_render(loaded, place, output, samples)
    _print_files(files, json)


@app.command()
def truth(
    scene: Annotated[
        Path, typer.Argument(help="Scene file or name, or a run folder of one: all its frames.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    position: Annotated[
        list[float] | None,
        typer.Option("--position", help="Track position, mm, again for more; the plan's start."),
    ] = None,
    json: Json = False,
) -> None:
    """Where everything in the picture really is: the line's centre, the board's marks."""
    from sim.datasets.files import taken_at, write_truth
    from sim.devices import load_checked

    if scene.is_dir():
        loaded, taken = _recorded(scene, position)
    else:
        loaded = load_checked(scene)
        taken = taken_at(loaded, position or [loaded.rig.plan.start_mm])
    with progress_bar("truth") as progress:
        files = write_truth(loaded, taken, output, progress)
    _print_files(files, json)


def _recorded(folder: Path, position: list[float] | None) -> tuple[Scene, list[Taken]]:
    """The scene and the pictures of a run folder, which has its own positions."""
    from lscan.acquisition.run import open_run
    from sim.datasets.files import taken_in
    from sim.truth.placement import check_placement

    if position:
        raise InputError(
            "a run folder has its own positions", where="--position", value=position[0],
            allowed="none with a run folder",
        )  # fmt: skip
    loaded, taken = taken_in(open_run(folder))
    check_placement(loaded)
    return loaded, taken


@app.command()
def views(
    scene: SceneFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    poses: Annotated[int, typer.Option("--poses", min=1, max=100, help="Of the board.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the poses and the noise.")] = 1,
    json: Json = False,
) -> None:
    """A board held into the sheet in many poses: what lscan calibrate-metric takes."""
    from sim.datasets.views import write_views
    from sim.devices import load_checked

    _print_files(write_views(load_checked(scene), output, poses, seed), json)


@app.command()
def bench(
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")] = Path(
        "out/bench.json"
    ),
    scenes: PaperFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Speed: against Mitsuba's volpath at equal noise, a frame, a picture, a profile."""
    from sim.validation.speed import run_bench

    _end_with_rows(
        "bench", run_bench(scenes or scenes_folder() / "paper", output, quick), [output], json
    )


@app.command()
def verify(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")] = Path(
        "out/verify"
    ),
    scenes: ScenesFolder = None,
    json_file: Annotated[
        Path | None, typer.Option("--json-file", help="Write the rows to this file as well.")
    ] = None,
    full: Annotated[bool, typer.Option("--full", hidden=True)] = False,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """The tank against closed forms, published values and other renderers; a page shows it."""
    from sim.validation.physics.run import run_verify
    from sim.validation.rows import write_rows

    if full and quick:
        raise typer.BadParameter("--full and --quick exclude each other")
    with progress_bar("verify") as progress:
        evidence = run_verify(output, scenes or scenes_folder(), quick, progress)
    if json_file is not None:
        write_rows(json_file, evidence.rows)
    files = [output / "report.html", output / "verify.json"]
    _end_with_rows("verify", evidence.rows, files, json)


@app.command()
def accuracy(
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")] = Path(
        "out/accuracy.json"
    ),
    scenes: ScenesFolder = None,
    photographs: Annotated[
        Path | None,
        typer.Option(
            "--photographs",
            envvar="LSCAN_PHOTOGRAPHS",
            help="Folder of real pictures, whose rows are skipped without it.",
        ),
    ] = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """How near to the truth the instrument measures, figure by figure, each with its bar."""
    from sim.validation.accuracy.run import run_accuracy

    with progress_bar("accuracy") as progress:
        rows = run_accuracy(scenes or scenes_folder(), photographs, output, quick, progress)
    if photographs is None and not json:
        print("skipped: the rows of real photographs, which need --photographs FOLDER")
    _end_with_rows("accuracy", rows, [output], json)


@app.command()
def serve(
    scene: SceneFile,
    http_port: Annotated[int, typer.Option("--http-port", help="Of the webcam; 0: any.")] = 0,
    fps: Annotated[float, typer.Option("--fps", help="Pictures per second.")] = 30.0,
    quality: Annotated[int, typer.Option("--quality", help="Of the JPEGs, 1 to 100.")] = 95,
    subsampling: Annotated[
        str, typer.Option("--subsampling", help="Chroma: 4:4:4, or a webcam's 4:2:2, 4:2:0.")
    ] = "4:4:4",
    switched_laser: Annotated[
        bool, typer.Option("--switched-laser", help="Lit only by M3, else always.")
    ] = False,
    prepare: Annotated[
        bool, typer.Option("--prepare", help="Render the whole plan before opening.")
    ] = False,
    places: Annotated[int, typer.Option("--places", help="Renderings kept, 5 MB each.")] = 64,
    dialect: Annotated[str, typer.Option("--dialect", help="grbl or marlin.")] = "grbl",
    link: Annotated[
        Path | None, typer.Option("--link", help="Lasting name for the serial port.")
    ] = None,
    write_rig: Annotated[
        Path | None, typer.Option("--write-rig", help="Rig file to write, for lscan.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", help="NAME@SECONDS after the start; none@SECONDS heals."),
    ] = None,
    json: Json = False,
) -> None:
    """The tank as a webcam (MJPEG, loopback) and a Grbl track; runs until Ctrl-C."""
    from sim.cli.serve import serve_until_stopped
    from sim.devices import load_checked
    from sim.emulators import ServeOptions

    options = ServeOptions(
        http_port=http_port,
        fps=fps,
        quality=quality,
        subsampling=subsampling,
        places=places,
        switched_laser=switched_laser,
        prepare=prepare,
        dialect=dialect,
        link=link,
    )
    serve_until_stopped(load_checked(scene), options, write_rig, fault or [], json)


@app.command()
def hardware(
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")] = Path(
        "out/hardware.json"
    ),
    scenes: ScenesFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Drivers, faults, resuming and the live page, on hardware that the tank emulates."""
    from sim.validation.robustness.campaign import kind_cells
    from sim.validation.robustness.run import run_hardware

    with progress_bar("hardware") as progress:
        evidence = run_hardware(scenes or scenes_folder(), output, quick, progress)
    if not json:
        headings = ["", "injected", "borne", "stopped the scan", "not clean"]
        print_table("faults", headings, kind_cells(evidence.outcomes))
    _end_with_rows("hardware", evidence.rows, [output], json)


def _end_with_rows(title: str, rows: Sequence[Row], files: Sequence[Path], json: bool) -> None:
    """Print the rows and where they are; exit code 1 where one is beyond its bar."""
    from sim.validation.rows import HEADINGS, all_passed, table_cells

    if json:
        print_json([row.as_json() for row in rows])
    else:
        print_table(title, HEADINGS, table_cells(rows))
        if any(row.quick for row in rows):
            print("a quick run: figures marked - were measured with too little effort to be judged")
        print(*files, sep="\n")
    if not all_passed(rows):
        raise typer.Exit(1)


def _print_files(files: dict[str, Path], json: bool) -> None:
    if json:
        print_json({name: str(path) for name, path in files.items()})
    else:
        for name, path in files.items():
            print(f"{name}: {path}")


def _print_summary(results: Any) -> None:
    points, stripe = results["control_points"], results["render_check"]
    print(
        f"control points: {points['found']} of {points['expected']}, "
        f"{points['rms_px']:.3f} px rms against the truth"
    )
    print(
        f"noise-free line: {stripe['stripe_rms_px']:.4f} px rms, "
        f"{stripe['stripe_max_px']:.3f} px at most; with the light the target and the water "
        f"throw about, {stripe['all_orders_rms_px']:.4f} px rms"
    )
    rows = []
    for method, found in results["distances"].items():
        errors = [entry["error_mm"] for entry in found.values()]
        errors += [entry["error_mm"] for entry in results["diameters"][method].values()]
        rms = (sum(error**2 for error in errors) / len(errors)) ** 0.5
        rows.append([method, rms, max(abs(error) for error in errors)])
    title = "Tables I and II by the paper's maps and the baselines"
    print_table(title, ["plane map", "rms error mm", "largest mm"], rows)
    yaw = results["sandwave"]["yaw_deg"]
    if yaw["estimated"] is not None:
        print(f"yaw: {yaw['estimated']:.3f} deg, truth {yaw['true']:.3f} deg")
    print_chains(results)


def main() -> None:
    """Entry point of the console script ``lscan-sim``."""
    run_command_line(app, "lscan-sim")


if __name__ == "__main__":
    main()
