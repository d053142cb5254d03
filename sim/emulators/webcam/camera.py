"""The emulated camera: it goes on taking pictures from where the head stands."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lscan.records import Bytes
from sim.emulators.options import ServeOptions
from sim.emulators.places import Places
from sim.processes import HelperEnded, HelperProcess
from sim.sensor.noise import jpeg_bytes

CameraFault = Literal["hang", "drop", "black", "wrong-size", "frozen"]
"""hang: connected, and sends no more pictures.  drop: breaks the connection and refuses new ones.
wrong-size: from now on half as wide and high.  frozen: the same picture, byte for byte."""
LONG_MOVE_S = 0.25  # longer than a step of a scan takes, and not much longer than a picture
PASSING_S = 0.02  # how often a further thread looks whether the head moves
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
    """A picture as a JPEG file.  number: from 1 on.  head: what it shows, as it was at begun_s."""

    number: int
    jpeg: bytes
    head: HeadState
    begun_s: float


class EmulatedCamera:
    """Pictures of the tank at a steady rate while anyone watches, in a thread of its own.

    A picture handed out while the head rests shows where it rests.  Once it rests where nothing
    has been rendered yet, nothing is handed out until that is done.  While it moves, the place
    where it rested is shown for LONG_MOVE_S, so that the short steps of a scan wait for no
    picture; from then on each picture is rendered from where the head is when it is taken, by
    processes on the other cores too, which are started at the first such move.
    """

    def __init__(
        self, places: Places, head_state: Callable[[], HeadState], options: ServeOptions, seed: int
    ) -> None:
        self._places, self._head_state, self._options = places, head_state, options
        self._generator = np.random.Generator(np.random.SFC64([seed, STREAM]))
        self._changed = threading.Condition()
        self._shot: Shot | None = None
        self._rested_mm, self._rested_s = head_state().now_mm, time.monotonic()
        self._watchers, self._ended, self._due_s = 0, False, 0.0
        self.fault: CameraFault | None = None
        self._helpers: list[HelperProcess] | None = None
        self._stack = ExitStack()
        self._threads = [threading.Thread(target=self._run, name="emulated camera", daemon=True)]
        self._threads[0].start()

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
        """End the threads; closing twice is harmless."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._threads[0].join()  # which alone starts others
        for helper in self._helpers or ():
            helper.kill()
        for thread in self._threads:
            thread.join()
        self._stack.close()

    def _is_true(self, after: int) -> bool:
        """Whether the last shot may still be handed out: the head may have left since."""
        if self._shot is None or self._shot.number <= after or self.fault == "hang":
            return False
        now, then = self._head_state(), self._shot.head
        return now.lit == then.lit and now.position_mm in (None, then.position_mm)

    def _run(self) -> None:
        while self._awaited():
            head, begun_s = self._head_state(), time.monotonic()
            if self._is_passing(head):
                self._begin_beside()
                view = self._places.passed(head.now_mm, lit=head.lit)
            elif head.position_mm is None:
                view = self._places.view(self._rested_mm, lit=head.lit)
            else:
                view = self._places.view(head.position_mm, lit=head.lit)
                self._rested_mm, self._rested_s = head.position_mm, time.monotonic()
            self._publish(view.picture(self._generator), head, begun_s)

    def _is_passing(self, head: HeadState) -> bool:
        """Whether each picture is to show where the head is at its moment."""
        return head.position_mm is None and time.monotonic() - self._rested_s > LONG_MOVE_S

    def _begin_beside(self) -> None:
        """Start the other processes and a thread for each, the first time."""
        if self._helpers is not None:
            return
        self._helpers = self._stack.enter_context(self._places.helpers())
        for number, helper in enumerate(self._helpers):
            seeds = np.random.Generator(np.random.SFC64(self._generator.integers(2**32, size=4)))
            args, name = (helper, seeds), f"emulated camera {number}"
            thread = threading.Thread(target=self._run_beside, args=args, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def _run_beside(self, helper: HelperProcess, seeds: np.random.Generator) -> None:
        """Publish pictures of what the head passes that another process takes, while it lasts."""
        with suppress(HelperEnded):
            helper.wait()
            while self._awaited(passing=True):
                head, begun_s = self._head_state(), time.monotonic()
                image = helper(head.now_mm, head.lit, int(seeds.integers(2**63)))
                self._publish(image, head, begun_s)

    def _awaited(self, passing: bool = False) -> bool:
        """Wait until the next picture is due and someone watches; False at the end.

        passing: and until the head passes what is to be shown.
        """
        with self._changed:
            while passing and not self._ended and not self._is_passing(self._head_state()):
                self._changed.wait(PASSING_S)
            due_s = max(self._due_s, time.monotonic())
            self._due_s = due_s + 1 / self._options.fps
            self._changed.wait_for(lambda: self._ended, max(0.0, due_s - time.monotonic()))
            self._changed.wait_for(lambda: self._ended or self._watchers > 0)
            return not self._ended

    def _publish(self, image: Bytes, head: HeadState, begun_s: float) -> None:
        """Show a picture of the head as it was, as it leaves a camera with this fault."""
        if self.fault == "black":
            image = np.zeros_like(image)
        elif self.fault == "wrong-size":
            image = image[::2, ::2]
        if self.fault == "frozen" and self._shot is not None:
            jpeg = self._shot.jpeg
        else:
            jpeg = jpeg_bytes(image, self._options.quality, self._options.subsampling)
        self._show(jpeg, head, begun_s)

    def _show(self, jpeg: bytes, head: HeadState, begun_s: float) -> None:
        """Let all see a picture, unless one that was begun later is there already."""
        with self._changed:
            if self._shot is None or begun_s > self._shot.begun_s:
                self._shot = Shot(self.count + 1, jpeg, head, begun_s)
                self._changed.notify_all()
