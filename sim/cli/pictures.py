"""``lscan-sim render``, ``truth`` and ``views``: pictures, and the truth of them."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.console import Json, progress_bar
from lscan.errors import InputError
from sim.cli.arguments import OutputFolder, SceneFile, print_places


def render(
    scene: SceneFile,
    output: OutputFolder,
    position: Annotated[
        float | None, typer.Option("--position", help="Track position, mm; the plan's start.")
    ] = None,
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
    print_places(files, json)


def truth(
    scene: Annotated[
        Path, typer.Argument(help="Scene file or name, or a run folder of one: all its frames.")
    ],
    output: OutputFolder,
    position: Annotated[
        list[float] | None,
        typer.Option("--position", help="Track position, mm, again for more; the plan's start."),
    ] = None,
    json: Json = False,
) -> None:
    """Where everything in the picture really is: the line's centre, the board's marks."""
    from lscan.acquisition.run import open_run
    from sim.datasets.files import taken_at, taken_in, write_truth
    from sim.devices import load_checked
    from sim.truth.placement import check_placement

    if scene.is_dir():
        if position:
            raise InputError(
                "a run folder has its own positions", where="--position", value=position[0],
                allowed="none with a run folder",
            )  # fmt: skip
        loaded, taken = taken_in(open_run(scene))
        check_placement(loaded)
    else:
        loaded = load_checked(scene)
        taken = taken_at(loaded, position or [loaded.rig.plan.start_mm])
    with progress_bar("truth") as progress:
        tables = write_truth(loaded, taken, output, progress)
    print_places({name: table.file for name, table in tables.items()}, json)
    if not json:
        for name, table in tables.items():
            found = ", ".join(f"{count} {status}" for status, count in table.statuses.items())
            print(f"{name}: {len(taken)} pictures, {sum(table.statuses.values())} entries: {found}")


def views(
    scene: SceneFile,
    output: OutputFolder,
    poses: Annotated[int, typer.Option("--poses", min=1, max=100, help="Of the board.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the poses and the noise.")] = 1,
    json: Json = False,
) -> None:
    """A board held into the sheet in many poses: what lscan calibrate-metric takes."""
    from sim.datasets.views import write_views
    from sim.devices import load_checked

    print_places(write_views(load_checked(scene), output, poses, seed), json)
