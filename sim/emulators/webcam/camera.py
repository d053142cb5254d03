"""The emulated camera: it goes on taking pictures from where the head stands."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim.emulators.options import ServeOptions
from sim.emulators.places import Places
from sim.sensor.coding import jpeg_bytes

CameraFault = Literal["hang", "drop", "black", "wrong-size", "frozen"]
"""hang: connected, and sends no more pictures.  drop: breaks the connection and refuses new ones.
wrong-size: from now on half as wide and high.  frozen: the same picture, byte for byte."""
LONG_MOVE_S = 0.25  # longer than a step of a scan takes, and not much longer than a picture
STREAM = 4  # of the sensor's seed; 0 to 3 are taken (sim.sensor.noise)


@dataclass(frozen=True)
class HeadState:
    """What there is to be seen.  position_mm: where the head rests, None while it moves.

    lit: whether the laser is on.  now_mm: where the head is at this moment.
    """

    position_mm: float | None
    lit: bool
    now_mm: float


@dataclass(frozen=True)
class Shot:
    """A picture as a JPEG file.  number: from 1 on.  head: what it shows."""

    number: int
    jpeg: bytes
    head: HeadState


class EmulatedCamera:
    """Pictures of the tank at a steady rate while anyone watches, in a thread of its own.

    A picture handed out while the head rests shows where it rests.  Once it rests where nothing
    has been rendered yet, nothing is handed out until that is done.  While it moves, the place
    where it rested is shown for LONG_MOVE_S, so that the short steps of a scan wait for no
    picture; from then on each picture is rendered from where the head is when it is taken.
    """

    def __init__(
        self, places: Places, head_state: Callable[[], HeadState], options: ServeOptions, seed: int
    ) -> None:
        self._places, self._head_state, self._options = places, head_state, options
        self._generator = np.random.Generator(np.random.SFC64([seed, STREAM]))
        self._changed = threading.Condition()
        self._shot: Shot | None = None
        self._rested_mm, self._rested_s = head_state().now_mm, time.monotonic()
        self._watchers, self._ended = 0, False
        self.fault: CameraFault | None = None
        self._thread = threading.Thread(target=self._run, name="emulated camera", daemon=True)
        self._thread.start()

    @property
    def count(self) -> int:
        """Pictures taken so far."""
        return self._shot.number if self._shot else 0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Someone watches within the block; without anyone, no picture is taken."""
        with self._changed:
            self._watchers += 1
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._watchers -= 1

    def newest(self, after: int, timeout_s: float) -> Shot | None:
        """The newest picture if its number is above ``after`` and it is still true, or becomes
        so in time; else None."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._is_true(after), timeout_s)
            return self._shot if self._is_true(after) and not self._ended else None

    def close(self) -> None:
        """End the thread; closing twice is harmless."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()

    def _is_true(self, after: int) -> bool:
        """Whether the last shot may still be handed out: the head may have left since."""
        if self._shot is None or self._shot.number <= after or self.fault == "hang":
            return False
        now, then = self._head_state(), self._shot.head
        return now.lit == then.lit and now.position_mm in (None, then.position_mm)

    def _run(self) -> None:
        due_s = time.monotonic()
        while self._awaited(due_s):
            due_s = max(due_s + 1 / self._options.fps, time.monotonic())
            shot = self._expose()
            with self._changed:
                self._shot = shot
                self._changed.notify_all()

    def _awaited(self, due_s: float) -> bool:
        """Wait until the next picture is due and someone watches; False at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended, max(0.0, due_s - time.monotonic()))
            self._changed.wait_for(lambda: self._ended or self._watchers > 0)
            return not self._ended

    def _expose(self) -> Shot:
        """The next picture."""
        head, last = self._head_state(), self._shot
        if self.fault == "frozen" and last is not None:
            return Shot(self.count + 1, last.jpeg, head)
        if head.position_mm is None and time.monotonic() - self._rested_s > LONG_MOVE_S:
            view = self._places.passed(head.now_mm, lit=head.lit)
        elif head.position_mm is None:
            view = self._places.view(self._rested_mm, lit=head.lit)
        else:
            view = self._places.view(head.position_mm, lit=head.lit)
            self._rested_mm, self._rested_s = head.position_mm, time.monotonic()
        image = view.picture(self._generator)
        if self.fault == "black":
            image = np.zeros_like(image)
        elif self.fault == "wrong-size":
            image = image[::2, ::2]
        jpeg = jpeg_bytes(image, self._options.quality, self._options.subsampling)
        return Shot(self.count + 1, jpeg, head)
