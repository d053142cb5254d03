"""How much of the accuracy table's work is done: all of it, or a quick look at every row."""

from dataclasses import dataclass
from pathlib import Path

from sim.scene import Scene, load_scene


@dataclass(frozen=True)
class AccuracyEffort:
    """What a run of the table measures; by default all of it.

    seeds: of sensor noise and speckle.  plane_map: through which workpieces are measured;
    None: the scene's own.  extractor: of the sandwave's line, likewise.  slice_step_mm: of the
    track between frames of the sandwave, likewise.  coverage_step_mm, cell_mm: the same where
    intervals are counted, and the grid's cells.  poses: of the metric route's board.  drawings:
    pictures of each kind of drawn line.  repeats: of a call that is timed.  plain: rendered with
    few samples, each pixel as a whole, in the first order of light.
    """

    seeds: tuple[int, ...] = tuple(range(1, 21))
    plane_map: str | None = None
    extractor: str | None = None
    slice_step_mm: float | None = None
    coverage_step_mm: float = 1.0
    cell_mm: float = 3.0
    poses: int = 10
    drawings: int = 100
    repeats: int = 9
    plain: bool = False

    @property
    def seeded(self) -> str:
        """The seeds in words."""
        return f"seeds {self.seeds[0]} to {self.seeds[-1]}"

    def scene(self, scene: Scene, samples: int = 1) -> Scene:
        """The scene as this effort renders it; samples: a pixel, of a plain one."""
        if not self.plain:
            return scene
        return scene.with_tank(render={"fineness": 1, "samples": samples, "scatter_samples": 0})

    def best(self, scenes: Path, name: str) -> Scene:
        """The scene of that name with the project's best methods, as this effort renders it."""
        return self.scene(load_scene(scenes / "best" / f"{name}.toml"))

    def map_name(self, board: Scene) -> str:
        """The plane map through which workpieces are measured, solved from that board."""
        return self.plane_map or board.rig.calibration.plane_map


FULL = AccuracyEffort()
QUICK = AccuracyEffort(
    seeds=(1,),
    plane_map="polynomial-5",  # a hundredth of the time that ray tracing takes to solve
    extractor="centroid-relative",  # a tenth of the time of "ml", with which the groove is read
    slice_step_mm=2.0,  # the longest with which the alignment has ten profiles across a wedge
    coverage_step_mm=2.0,
    cell_mm=6.0,
    poses=4,
    drawings=4,
    repeats=1,
    plain=True,
)
