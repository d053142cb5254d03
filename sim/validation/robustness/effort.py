"""How much of the hardware table's work is done: all of it, or a quick look at every row."""

from dataclasses import dataclass


@dataclass(frozen=True)
class HardwareEffort:
    """What a run of the table does.

    live_frames: of the scan beside the live page.  live_s: over which pictures are counted.
    overhead_frames: of the scan without devices.  scan_frames: of the scan on the served tank.
    aligned: whether that scan is compared on the workpiece's slices, which takes a hundred
    frames, or column by column.  kills: of a scan, in runs of so many kill_frames.
    every_field: how many of the wrong rig files are passed over for one that is tried.
    faults: of each kind.
    """

    live_frames: int
    live_s: float
    overhead_frames: int
    scan_frames: int
    aligned: bool
    kills: int
    kill_frames: int
    every_field: int
    faults: int


FULL = HardwareEffort(
    live_frames=100,
    live_s=12.0,
    overhead_frames=240,
    scan_frames=100,  # as few as the alignment takes: ten profiles across each wedge
    aligned=True,
    kills=20,
    kill_frames=120,  # taking them lasts about as long as starting the program and its renderer
    every_field=1,
    faults=23,
)
QUICK = HardwareEffort(
    live_frames=20,
    live_s=2.0,
    overhead_frames=24,
    scan_frames=6,
    aligned=False,
    kills=2,
    kill_frames=40,
    every_field=25,
    faults=1,
)
