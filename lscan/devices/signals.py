"""Ctrl-C and SIGTERM: what runs is ended in order, so that no laser stays lit."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def on_stop_signals(act: Callable[[], None]) -> Iterator[None]:
    """Let SIGINT and SIGTERM call a function within the block.

    SIGINT does so also where the process was begun with it ignored, as ``nohup``, cron and a
    script's ``&`` do: whoever then sends it by ``kill -INT`` means it.  SIGTERM, whose default
    is to end the process at once, would leave a laser lit and a track moving.

    Parameters
    ----------
    act : callable, called by the signal, in the main thread
    """
    if threading.current_thread() is not threading.main_thread():  # which alone may set handlers
        yield
        return
    stopping = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: act()) for number in stopping}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
