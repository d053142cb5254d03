"""How much of the hardware table's work is done: all of it, or a quick look at every row."""

from dataclasses import dataclass, field

from lscan.config.documents import Document


@dataclass(frozen=True)
class HardwareEffort:
    """What a run of the table does; by default all of it.

    live_frames: of the scan beside the live page.  live_s: over which pictures are counted.
    moving_s: that a head moves whose pictures are counted.
    overhead_frames: of the scan without devices.  scan_frames: of the scan on the served tank.
    aligned: whether that scan is compared on the workpiece's slices, which takes a hundred
    frames, or column by column.  kills: of a scan, in runs of so many kill_frames.
    render: what replaces the scenes' own settings of rendering, where no figure is about them.
    every_field: one in so many of the wrong rig files is tried.
    faults: of each kind.
    """

    live_frames: int = 100
    live_s: float = 12.0
    moving_s: float = 12.0
    overhead_frames: int = 240
    scan_frames: int = 100  # as few as the alignment takes: ten profiles across each wedge
    aligned: bool = True
    kills: int = 20
    kill_frames: int = 120  # lasts about as long as starting the program and its renderer
    render: Document = field(default_factory=dict)
    every_field: int = 1
    faults: int = 23


FULL = HardwareEffort()
QUICK = HardwareEffort(
    live_frames=20,
    live_s=2.0,
    moving_s=2.0,
    overhead_frames=24,
    scan_frames=6,
    aligned=False,
    kills=2,
    kill_frames=60,  # with more, other processes help, which have to start
    render={"samples": 1, "scatter_samples": 0},
    every_field=25,
    faults=1,
)
