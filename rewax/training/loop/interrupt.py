"""Stopping a run cleanly: the first Ctrl-C asks it to finish its iteration, the second ends it at once."""

import contextlib
import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_SAME_SECONDS = 0.3  # supervisors such as `timeout` signal a process and its group: two signals, but one request


class Stop:
    """Whether the user asked to stop.

    Attributes:
      signum: the signal that requested the stop; 0 before a request.
      at_once: while not empty, the first signal ends the process at once, with this sentence for the user.
      before_exit: called before the process ends at once.
      notice: sentence for the user at the first signal otherwise.
    """

    signum: int = 0
    at_once: str = ""
    before_exit: Callable[[], object] = staticmethod(lambda: None)
    notice: str = "stopping after this iteration; once more to leave at once"

    @property
    def requested(self) -> bool:
        """Whether a signal has requested a stop."""
        return self.signum != 0


@contextlib.contextmanager
def graceful_stop(notify: Callable[[str], None]) -> Iterator[Stop]:
    """Within the block, SIGINT, SIGTERM and SIGHUP set ``Stop.signum``; a second signal ends the process at once.

    The first signal does too while ``Stop.at_once`` is set: nothing is worth waiting for while a program compiles.

    A thread listens for signals, because Python runs its own handlers only between bytecodes, and a compiled iteration
    or a compilation can take minutes between two of them. Outside the main thread no handler is installed, and signals
    keep their usual effect.

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
            if signum == getattr(signal, "SIGHUP", 0):
                _leave_terminal()
            if stop.requested:
                if time.monotonic() - first < _SAME_SECONDS:
                    continue
                os._exit(128 + signum)
            if stop.at_once:
                try:
                    stop.before_exit()
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


def _leave_terminal() -> None:
    """After SIGHUP the terminal is gone, and writing to it would raise. So output to a terminal is discarded."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):
                os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
