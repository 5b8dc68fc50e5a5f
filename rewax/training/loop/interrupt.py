"""Stopping a run cleanly: the first Ctrl-C asks, the second insists."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SAME_SECONDS = 0.3  # supervisors such as `timeout` signal a process and its group: twice, but meant once


class Stop:
    """Whether the user asked to stop.

    Attributes:
      signum: the signal that asked, 0 while none has.
      at_once: while not empty, the first signal ends the process at once, with this sentence for the user.
      notice: what the user is told at the first signal otherwise.
    """

    signum: int = 0
    at_once: str = ""
    notice: str = "stopping after this iteration; once more to leave at once"

    @property
    def requested(self) -> bool:
        """A signal has asked to stop."""
        return self.signum != 0


@contextlib.contextmanager
def graceful_stop(notify: Callable[[str], None]) -> Iterator[Stop]:
    """Within the block, SIGINT and SIGTERM set ``Stop.signum``; a second one ends the process at once.

    The first one does too while ``Stop.at_once`` is set: nothing is worth waiting for while a program compiles.

    A thread listens, because Python runs its own handlers only between bytecodes, and an iteration or a compilation can
    be minutes of none. Outside the main thread nothing is installed, and the block never hears of a stop.

    Args:
      notify: called with a sentence for the user when the first signal arrives.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def listen() -> None:
        first = 0.0
        while received := os.read(reader, 1):
            signum = received[0]
            if signum not in _SIGNALS:
                continue
            if stop.requested:
                if time.monotonic() - first < _SAME_SECONDS:
                    continue
                os._exit(128 + signum)
            if stop.at_once:
                try:
                    notify(stop.at_once)
                    sys.stdout.flush()
                finally:
                    os._exit(128 + signum)
            first, stop.signum = time.monotonic(), signum
            notify(stop.notice)

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    old_fd = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    old_handlers = {number: signal.signal(number, lambda *_: None) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        signal.set_wakeup_fd(old_fd)
        os.close(writer)  # ends the listener
        listener.join()
        os.close(reader)
