"""Whether a scan stays within its track's travel, told before any device is touched."""

from __future__ import annotations

from lscan.config.rig import RigFile
from lscan.errors import InputError


def check_plan(rig_file: RigFile, low_mm: float, high_mm: float, slack_mm: float = 0.0) -> None:
    """Raise InputError where the first or the last position of the plan lies outside the travel.

    low_mm, high_mm: the travel, ``track.options.min_mm`` and ``max_mm``.  slack_mm: how far
    beyond it the track still goes.
    """
    plan = rig_file.rig.plan
    last_mm = plan.start_mm + (plan.frames - 1) * plan.step_mm
    ends = {
        "plan.start_mm": plan.start_mm,
        "plan.start_mm + (plan.frames - 1) * plan.step_mm": last_mm,
    }
    for key, position_mm in ends.items():
        if not low_mm - slack_mm <= position_mm <= high_mm + slack_mm:
            raise InputError(
                f"{key}: leaves the track's travel",
                where=rig_file.source,
                value=position_mm,
                allowed=f"{low_mm:.9g} to {high_mm:.9g} mm, track.options.min_mm and max_mm",
            )
