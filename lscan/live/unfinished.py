"""The run that was left unfinished in the folder of the runs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lscan.acquisition.run import MANIFEST, TABLE, most_table_bytes, read_manifest
from lscan.acquisition.samerig import require_same_rig
from lscan.config.rig import RigFile
from lscan.errors import LscanError
from lscan.files.disk import read_bytes


@dataclass(frozen=True)
class Unfinished:
    """A run folder and the number of frames it holds already."""

    folder: Path
    done: int


def find_unfinished(output: Path, rig_file: RigFile) -> Unfinished | None:
    """Of the runs of this very rig in folders of ``output`` the one written to last, if unfinished.

    None where that one is complete or there is none: an older one is left to ``lscan scan
    --resume``.  Reads only; what a kill left of a frame is cleared away once it is resumed.
    """
    tables = [table for table in output.glob(f"*/{TABLE}") if table.is_file()]
    for table in sorted(tables, key=_written_s, reverse=True):
        with suppress(LscanError, OSError):
            manifest, begun = read_manifest(table.parent)
            require_same_rig(begun, rig_file, where=table.parent / MANIFEST)
            if manifest.state == "complete":
                return None
            held = read_bytes(table, most_table_bytes(manifest.plan), within=table.parent)
            rows = held.count(b"\n") - 1  # under the header, a torn one left out
            return Unfinished(table.parent, max(rows, 0))
    return None


def _written_s(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # gone meanwhile
        return 0.0
