"""The command line: the composition root, the only module that sees everything.

Each command is a frozen dataclass whose fields are its options; `run` returns the exit status. What is heavy is
imported when a command runs, so that help appears at once.
"""

import io
import logging
import os
import sys
from collections.abc import Sequence

from modeler.cli.interrupt import terminable
from modeler.cli.saying import say
from modeler.cli.usage import Command, parsed

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 2 unusable input, 3 done but not trustworthy.

    Args:
        arguments: what follows the program's name; those of the process without it.
    """
    logging.basicConfig(level=logging.WARNING, format="modeler: %(message)s")  # to stderr
    # Rerun complains in its own way of a viewer that was closed, which is nobody's error, and of a disk that is full;
    # we tell what matters.
    os.environ.setdefault("RUST_LOG", "warn,re_sdk=off,re_grpc_client=off,re_log_encoding=off")
    # Our matrices are small: to wake BLAS threads takes longer than what they would do.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be text
    try:
        try:
            return _run(parsed(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()  # so that a reader who has left is noticed here
    except BrokenPipeError:
        _close_stdout()
        return 1
    except OSError as error:
        if error.errno is None:
            raise
        if error.filename is not None:
            say(f"{error.filename}: cannot be used ({error.strerror}); check the path and its permissions")
            return 2
        _close_stdout()
        say(f"output cannot be written ({os.strerror(error.errno)}); make room, or send it elsewhere")
        return 2
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED


def _close_stdout() -> None:
    """Say nothing more there, at exit either."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(command: Command) -> int:
    """Run a command and return its exit status; what cannot be used is said in one line."""
    from modeler.types import InputError

    try:
        with terminable():
            return command.run()
    except InputError as error:
        say(str(error).strip().removesuffix("."))
        return 2
