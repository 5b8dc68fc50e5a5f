"""The commands by name; an error in the input becomes one sentence and an exit code."""

import contextlib
import difflib
import errno
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence

_SUMMARIES = {
    "train": "train a policy on an environment",
    "eval": "evaluate a trained policy",
    "bench": "compare algorithms on tasks, one table",
    "tune": "search for hyper-parameters",
    "play": "show trained policies in a browser",
    "plot": "compare learning curves of runs",
    "record": "record a body with a simulated camera",
    "identify": "find physical parameters from a record",
    "export": "write a trained policy for programs without rewax",
    "landscape": "draw the returns around a trained policy",
    "envs": "list or describe the environments",
    "check": "check your own environment against the protocol",
    "doctor": "print what is installed, and problems with remedies",
    "completion": "print a script that completes commands in a shell",
}
COMMANDS = {
    "train": "rewax.cli.train",
    "eval": "rewax.cli.evaluate",
    "bench": "rewax.cli.bench",
    "tune": "rewax.cli.tune",
    "play": "rewax.cli.play",
    "plot": "rewax.cli.plot",
    "record": "rewax.cli.record",
    "identify": "rewax.cli.identify",
    "export": "rewax.cli.export",
    "landscape": "rewax.cli.landscape",
    "envs": "rewax.cli.environments",
    "check": "rewax.cli.check",
    "doctor": "rewax.cli.doctor",
    "completion": "rewax.cli.completion",
}
"""Modules of the commands by name."""
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_WRONG_PATH = (
    errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENAMETOOLONG
)  # fmt: skip
_SMALLER = "take fewer environments, episodes, pixels or particles, or a machine with more"
_CLEAN_EXIT, _CANNOT_GO_ON, _BAD_INPUT = 0, 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
      argv: name of the command and its arguments; by default those of the process.

    Returns:
      Exit code: 0; 1 after a run that failed, or where memory or disk are too small; 2 after a sentence about an error
      in the input; 128 + signal after an interruption.
    """
    # Set before jax is imported: jax 0.10 prints an "error" for every program that it finds in its cache.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        with _sentences_for_warnings():
            code = _run(argv)
        sys.stdout.flush()
        return code
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return _BAD_INPUT
    except (MemoryError, RuntimeError) as error:  # NumPy's, and that of a device
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        needed = next(iter(str(error).splitlines()), "").rstrip(".") or "out of memory"
        print(f"error: the memory is too small ({needed}): {_SMALLER}", file=sys.stderr)
        return _CANNOT_GO_ON
    except KeyboardInterrupt:  # before the training loop handles it
        return 128 + signal.SIGINT
    except BrokenPipeError:  # the reader of the output has ended, such as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        path = error.filename2 or error.filename  # the second one is that which a file was to be renamed to
        if path and error.errno in _WRONG_PATH:
            print(f"error: {path} cannot be written or read ({error.strerror}): choose another", file=sys.stderr)
            return _BAD_INPUT
        if error.errno in _NO_SPACE:
            what = error.filename or "a file"
            print(f"error: {what} cannot be written ({error.strerror}): free some space", file=sys.stderr)
        elif type(error).__name__ == "CannotWrite":  # rewax.training.storage.run_directory, slow to import
            print(f"error: {error}", file=sys.stderr)
        else:
            raise
        return _CANNOT_GO_ON


@contextlib.contextmanager
def _sentences_for_warnings() -> Iterator[None]:
    """Inside, warnings to users are printed as one sentence, without the place in the source that gave them."""
    standard = warnings.formatwarning

    def as_sentence(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
    ) -> str:
        if issubclass(category, UserWarning):
            return f"warning: {message}\n"
        return standard(message, category, filename, lineno, line)

    warnings.formatwarning = as_sentence
    try:
        yield
    finally:
        warnings.formatwarning = standard


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_help())
        return _CLEAN_EXIT if argv else _BAD_INPUT
    if argv[0] not in COMMANDS:
        close = difflib.get_close_matches(argv[0], COMMANDS, n=1)
        near = f"did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"there is no command {argv[0]!r}: {near}use one of {', '.join(COMMANDS)}, or --help")
    command = importlib.import_module(COMMANDS[argv[0]])
    return command.run(argv[1:])


def _help() -> str:
    lines = [f"  rewax {name:10s} {what}" for name, what in _SUMMARIES.items()]
    return "\n".join(["usage: rewax COMMAND [OPTIONS]", "", *lines, "", "rewax COMMAND --help lists the options."])


__all__ = ["COMMANDS", "main"]
