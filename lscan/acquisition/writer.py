"""Writing a run folder so that any moment is a safe one to be killed at.

A frame is written in this order: the picture under a temporary name, synced, renamed, its
folder synced; its background, if it has one, in the same way; then its row, synced.  So a row
always has its pictures.  What a killed scan may leave is a temporary file, a picture without a
row, or a torn last row; ``resume_run`` clears these away and goes on.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Self

import cv2

from lscan.acquisition.run import (
    FRAMES,
    MANIFEST,
    TABLE,
    FrameRow,
    Manifest,
    Run,
    columns,
    frame_file,
    most_table_bytes,
    open_run,
    read_manifest,
    recording_versions,
    require_same_camera,
    require_same_files,
    require_same_rig,
)
from lscan.config.documents import named_files
from lscan.config.rig import RigFile
from lscan.devices.api import Camera, Identified
from lscan.errors import InputError, LscanError
from lscan.files.disk import (
    LOCK,
    append_synced,
    cut_torn_line,
    disk_errors,
    list_names,
    lock_folder,
    open_to_append,
    require_within,
    sync_folder,
    write_atomically,
)
from lscan.files.pictures import encode_picture, with_bits
from lscan.records import Frame, Picture


class RunWriter:
    """A run folder being written, locked so that two scans cannot mix.

    Made by ``create_run`` or ``resume_run``; use it in a ``with`` statement.

    Parameters
    ----------
    path : Path, of the run folder
    rig_file : RigFile, the rig the run is made with
    lock : int, descriptor of the locked folder; closed with the writer
    rows : sequence, the frames recorded so far

    Attributes
    ----------
    written : int, number of frames recorded so far
    last_mm : float or None, mm, the position at which the last of them was taken, None before the
        first
    manifest : Manifest, what run.json holds
    """

    def __init__(
        self, path: Path, rig_file: RigFile, lock: int, rows: Sequence[FrameRow] = ()
    ) -> None:
        self.path, self.rig_file = path, rig_file
        self.manifest = Manifest.from_file(path / MANIFEST)
        self.written = len(rows)
        self.last_mm = rows[-1].position_mm if rows else None
        table = open_to_append(path / TABLE)
        self._table, self._held = table, [lock, table]
        self._shape: tuple[int, ...] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Let go of the folder; an error of the block, or Ctrl-C, gets a note of what is kept."""
        self.close()
        if isinstance(error, (LscanError, KeyboardInterrupt)):
            error.add_note(
                f"{self.written} of {self.planned} frames are kept in {self.path}; "
                "go on with --resume"
            )

    def close(self) -> None:
        """Let go of the folder; closing twice is harmless."""
        while self._held:
            os.close(self._held.pop())

    @property
    def planned(self) -> int:
        """Number of frames of the whole scan."""
        return self.rig_file.rig.plan.frames

    def keep(self, **values: Any) -> None:
        """Write run.json with these values of the manifest, where they are others than it has.

        Parameters
        ----------
        **values : by the names of ``Manifest``, such as ``track_zero``
        """
        self.manifest = _with_values(self.path, self.manifest, values)

    def keep_camera(self, camera: Camera) -> None:
        """Write into run.json which camera takes a new run, or compare with what it says.

        Parameters
        ----------
        camera : Camera, opened

        Raises
        ------
        DeviceError
            The frames so far were taken with another camera.
        """
        if not self.written:
            identity = camera.identity if isinstance(camera, Identified) else None
            self.keep(camera_identity=identity)
        else:
            require_same_camera(self.manifest.camera_identity, camera)

    def append(self, frame: Frame) -> None:
        """Write the next frame; when this returns, pictures and row are on disk, synced.

        Parameters
        ----------
        frame : Frame, its index must be ``written``; it has a background where, and only where, the
            plan is of pairs

        Raises
        ------
        InputError
            The frame is out of order, its picture is unlike the first one's, it has a background
            where the plan is not of pairs or none where it is, the writer is closed, or the disk
            refuses; the frames before this one stay whole.
        """
        if not self._held:
            raise InputError("cannot be written: the writer is closed", where=self.path)
        if frame.index != self.written or frame.index >= self.planned:
            what = "frame out of order"
            raise InputError(what, where=self.path, value=frame.index, allowed=self.written)
        self._require_alike(frame)
        if (frame.background is not None) != self.rig_file.rig.plan.paired:
            what = "a frame of a paired run needs a background, any other has none"
            raise InputError(what, where=self.path, value=frame.index)
        sha256 = _write_picture(frame.image, frame_file(self.path, frame.index))
        dark_sha256 = None
        if frame.background is not None:
            dark_file = frame_file(self.path, frame.index, dark=True)
            dark_sha256 = _write_picture(frame.background, dark_file)
        places_mm = frame.commanded_mm, frame.position_mm
        row = FrameRow(
            frame.index, *places_mm, frame.time_s, frame.exposure_ms, sha256, dark_sha256
        )
        append_synced(self._table, f"{row.as_text()}\n".encode(), self.path / TABLE)
        self.written += 1
        self.last_mm = frame.position_mm

    def _require_alike(self, frame: Frame) -> None:
        """Raise InputError where the picture is not of the shape of the run's first one.

        A camera's driver sees to it while it is open; a run may be resumed with another.
        """
        if self.written and self._shape is None:
            self._shape = open_run(self.path, trusted=True).frame(0).image.shape
        self._shape = self._shape or frame.image.shape
        if frame.image.shape != self._shape:
            what = (
                f"frame {frame.index} is not like the frames before; set the camera as it was, "
                "or begin a new scan"
            )
            raise InputError(what, where=self.path, value=frame.image.shape, allowed=self._shape)

    def finish(self) -> Run:
        """Mark the run complete, where it is not yet, and return it.

        Raises InputError where frames are still missing.
        """
        if self.written < self.planned:
            what = "frames are missing"
            raise InputError(what, where=self.path, value=self.written, allowed=self.planned)
        self.keep(state="complete")
        return open_run(self.path, trusted=True)


def create_run(path: Path, rig_file: RigFile) -> RunWriter:
    """A writer of a new run.

    Parameters
    ----------
    path : Path, of the run folder, which must not exist
    rig_file : RigFile, the rig the run is made with

    Raises
    ------
    InputError
        The folder exists, cannot be made, or the rig cannot be kept as JSON; no folder is left
        behind then.
    """
    manifest = _new_manifest(rig_file)
    refuse_existing(path)
    with disk_errors(path):
        path.mkdir(parents=True)
    lock = lock_folder(path)
    try:
        _lay_out(path, manifest)
        return RunWriter(path, rig_file, lock)
    except BaseException:
        os.close(lock)
        shutil.rmtree(path, ignore_errors=True)
        raise


def resume_run(path: Path, rig_file: RigFile) -> RunWriter:
    """A writer that goes on where a run stopped.

    A scan killed before its manifest was written has left no folder or an empty one; it is begun.

    Parameters
    ----------
    path : Path, of the run folder
    rig_file : RigFile, the rig the run was begun with; how the devices are reached may have
        changed, and run.json keeps what it was

    Raises
    ------
    InputError
        The folder is something else than a run, was begun with another rig (the first differing key
        path is named) or with a mesh, say, that was changed since, is being written by another
        scan, or is damaged in a way that being killed does not explain.
    """
    if not os.path.exists(path):  # noqa: PTH110 - takes any text
        return create_run(path, rig_file)
    lock = lock_folder(path)
    try:
        require_within(path / FRAMES, path)
        if holds_no_run(path):
            _remove_temporaries(path)
            _lay_out(path, _new_manifest(rig_file))
            return RunWriter(path, rig_file, lock)
        return RunWriter(path, rig_file, lock, _recover(path, rig_file))
    except BaseException:
        os.close(lock)
        raise


def refuse_existing(path: Path) -> None:
    """Raise InputError where there is something at ``path`` already."""
    if os.path.lexists(path):
        allowed = (
            "another folder; or, to go on with the run there or take it as it is if "
            "complete, --resume, in Python resume=True"
        )
        raise InputError("exists already", where=path, allowed=allowed)


def _new_manifest(rig_file: RigFile) -> Manifest:
    try:
        json.dumps(rig_file.document, allow_nan=False)
    except (TypeError, ValueError) as error:
        what = f"holds a value that a run folder cannot keep: {error}"
        allowed = "text, finite numbers, true, false, lists and tables"
        raise InputError(what, where=rig_file.source, allowed=allowed) from error
    software, plan = [recording_versions(rig_file.rig)], rig_file.rig.plan
    files = named_files(rig_file.document)
    return Manifest(
        state="scanning", software=software, plan=plan, rig=rig_file.document, files=files
    )


def _with_values(path: Path, before: Manifest, values: dict[str, Any]) -> Manifest:
    """The manifest with these values, written where they are others than it had."""
    manifest = before.model_copy(update=values)
    if manifest != before:
        write_atomically(path / MANIFEST, manifest.as_text().encode())
    return manifest


def _lay_out(path: Path, manifest: Manifest) -> None:
    """Make an empty run; run.json comes last, so where it is the folder is whole."""
    with disk_errors(path):
        (path / FRAMES).mkdir(exist_ok=True)
    write_atomically(path / TABLE, f"{columns(manifest.plan.paired)}\n".encode())
    write_atomically(path / MANIFEST, manifest.as_text().encode())
    with disk_errors(path):
        sync_folder(path.parent)


def holds_no_run(path: Path) -> bool:
    """Whether ``resume_run`` begins a new run there.

    It does where nothing is there, or a folder with no more than a scan killed before its
    manifest was written has left.

    Parameters
    ----------
    path : Path, of the run folder

    Raises
    ------
    InputError
        It cannot be read as a folder.
    """
    if not os.path.exists(path):  # noqa: PTH110 - takes any text
        return True
    names = list_names(path)
    frames = list_names(path / FRAMES) if FRAMES in names else set()
    early = (FRAMES, TABLE, LOCK, f".{TABLE}*.tmp", f".{MANIFEST}*.tmp")
    return not frames and all(any(fnmatch(name, one) for one in early) for name in names)


def _recover(path: Path, rig_file: RigFile) -> tuple[FrameRow, ...]:
    """Clear away what a killed scan left, check the rest, return the rows of the frames."""
    manifest, kept = read_manifest(path)
    require_same_rig(kept, rig_file, where=path / MANIFEST)
    require_same_files(manifest.files, path)
    if manifest.state == "scanning":
        _remove_temporaries(path)
        cut_torn_line(path / TABLE, most_table_bytes(manifest.plan))
        if manifest.software[-1] != (now := recording_versions(rig_file.rig)):
            _with_values(path, manifest, {"software": [*manifest.software, now]})
    run = open_run(path, trusted=True)  # its rig is the one the user gave
    run.verify()
    return run.rows


def _remove_temporaries(path: Path) -> None:
    with disk_errors(path):
        for pattern in (".*.tmp", f"{FRAMES}/.*.tmp"):
            for file in path.glob(pattern):
                file.unlink()


# In noise nothing repeats: looking for repetitions, as OpenCV does by default, costs a fifth of
# the time and saves nothing.  Other levels and filters are slower or, on some pictures, larger by
# a third.  What JPEG has smoothed gets larger by this, all but black pictures several times, but
# no picture takes longer than a noisy one.
PNG = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
"""How the pictures of a run are coded, as ``cv2.imencode`` takes it."""


def _write_picture(image: Picture, file: Path) -> str:
    """Write a picture, synced; the SHA-256 of its file."""
    png = with_bits(encode_picture(image, ".png", PNG, where=file), image)
    write_atomically(file, png)
    return hashlib.sha256(png).hexdigest()
