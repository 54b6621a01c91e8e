"""The command line: the composition root, the only module that imports everything.

Each command is a frozen dataclass whose fields are its options; `run` returns the exit status, or raises `InputError`
where options, input or output cannot be used. Heavy imports are inside functions, so that help appears at once.
"""

import contextlib
import errno
import gc
import importlib
import inspect
import io
import logging
import os
import re
import resource
import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import partial
from itertools import takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from modeler.cli import messages
from modeler.cli.console import INTERRUPTED, endable, say, worded_as_options
from modeler.cli.overview import SUMMARIES, Command, command_class, overview
from modeler.system.processes import check_room, share_one_heap

complain = partial(say, level=logging.ERROR)
_ROOM = 7 * 2**27  # bytes of addresses that registering two frames takes, a third of them used
_FILES = 256  # open at the same time: Rerun ends the process where it cannot open its own
_CHOICES = re.compile(r"Expected one of \(([^)]*)\)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 2 unusable input, 3 done but not trustworthy.

    Args:
        arguments: those after the program's name; None: those of the process.
    """
    _open_standard_streams()
    share_one_heap()
    logging.basicConfig(level=logging.WARNING, format="modeler: %(message)s")  # to stderr
    if not any(isinstance(handler, messages.ToLog) for handler in logging.root.handlers):
        logging.root.addHandler(messages.ToLog())
    for handler in logging.root.handlers:
        handler.addFilter(worded_as_options)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of a home that it cannot write to
    logging.raiseExceptions = False  # stderr may be full
    # Our matrices are small: waking BLAS threads takes longer than their work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be text
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        asked, words = messages.split(arguments)
        with messages.kept(asked, arguments):
            return _ended(words)
    except messages.Wrong as error:
        complain(str(error))
        return 2


def _ended(arguments: Sequence[str]) -> int:
    """Run one command and return its exit status, whatever happens."""
    try:
        try:
            return _run(parsed(arguments))
        finally:
            sys.stdout.flush()  # so that a closed pipe is noticed here
    except BrokenPipeError:
        _close_stdout()
        return 1
    except (MemoryError, OSError, RuntimeError, ImportError) as error:
        if _exhausted(error):
            complain("memory or threads are exhausted; raise the limits (ulimit -v, -u), or end other programs")
            return 2
        if isinstance(error, ModuleNotFoundError) and not (error.name or "modeler").startswith("modeler"):
            how = f"run make setup, or {shlex.quote(sys.executable)} -m pip install {error.name}"
            complain(f"the package {error.name} is not installed, which this command needs; {how}")
            return 2
        if not isinstance(error, OSError) or error.errno is None:
            raise
        if error.filename is not None:
            complain(f"{error.filename}: cannot be used ({error.strerror}); check the path and its permissions")
            return 2
        _close_stdout()
        complain(f"output cannot be written ({os.strerror(error.errno)}); free disk space, or redirect it")
        return 2
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED


def parsed(arguments: Sequence[str]) -> Command:
    """Return the command for arguments (after the program's name).

    Raises:
        SystemExit: with status 0 after help or version, with 2 and one line on stderr for invalid arguments.
    """
    name, *others = messages.split(arguments)[1] or ("",)
    if name == "help":
        name, others = (others[0], ["--help"]) if others[:1] and others[0] in SUMMARIES else ("--help", [])
    if name == "--version":
        from importlib.metadata import version

        print(f"modeler {version('modeler')}")
        raise SystemExit(0)
    if name in ("-h", "--help"):
        print(overview(), end="")
        raise SystemExit(0)
    if name not in SUMMARIES:
        near = get_close_matches(name, SUMMARIES, n=1)
        kind = "option" if name.startswith("-") else "command"
        wrong = f"unknown {kind} '{name}'" if name else "no command given"
        hint = f"did you mean '{near[0]}'?" if near else f"the commands are {', '.join(SUMMARIES)};"
        complain(f"{wrong}; {hint} see modeler --help")
        raise SystemExit(2)
    import tyro

    command, conf, box = command_class(name), tyro.conf, io.StringIO()
    style = conf.OmitSubcommandPrefixes, conf.OmitArgPrefixes, conf.FlagCreatePairsOff, conf.DisallowNone
    # It asks typeguard, which takes 0.05 s to import, whether defaults are of the declared types, as is checked before.
    unasked = SimpleNamespace(check_type=lambda value, _: value, TypeCheckError=TypeError)
    try:
        with contextlib.redirect_stderr(box), _instead_of("typeguard", unasked):
            description = f"{inspect.cleandoc(command.__doc__ or '')}\n\n{messages.HELP}"
            return tyro.cli(command, prog=f"modeler {name}", description=description, args=others, config=style)
    except SystemExit as ending:
        if ending.code:
            complain(f"{_one_line(box.getvalue())}; see modeler {name} --help")
        raise


def _one_line(box: str) -> str:
    """Return the parser's error box as one line: its first section, and the options it suggests without their help."""
    rows = [re.sub(r"\x1b\[[0-9;]*m|\[/?bold\]", "", row).strip("│|╭╮╰╯").rstrip() for row in box.splitlines()[1:]]
    sections = [[]]
    for row in rows:
        if row and not row.strip("─+- "):
            sections.append([])
        elif not row.startswith(" " * 8):  # an option's description
            sections[-1].append(row)
    lines = [[" ".join(row.split()) for row in takewhile(bool, section)] for section in sections]
    what, *others = filter(None, lines)  # where there is no border, a line below the title is a section, too
    what = _CHOICES.sub(_in_order, " ".join(what))
    suggested = [f"{first} {' or '.join(more)}" for first, *more in others if first.startswith("Perhaps")]
    return "; ".join(line.rstrip(".") for line in (what, *suggested))


def _in_order(choices: re.Match[str]) -> str:
    """Return the choices of an option in alphabetical order, without that which stands for none being given."""
    names = {*re.findall(r"'([^']*)'", choices[1])} - {"None"}
    return f"Expected one of {', '.join(sorted(names))}"


def _run(command: Command) -> int:
    """Run a command and return its exit status; unusable input is reported in one line."""
    _check_environment()
    check_room(_ROOM)
    with endable():
        # Without the settings that Numba looks for in the current folder, in a file of YAML.
        with _instead_of("yaml", None), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module("numba")
        from modeler.cli.pages import View

        importlib.import_module("modeler.viz.viewer" if isinstance(command, View) else "modeler.cli.reading")
        from modeler.types import InputError
    try:
        with endable():
            _check_names(command)
            if not gc.isenabled():
                gc.freeze()  # what is imported lives to the end
                gc.enable()
            return command.run()
    except InputError as error:
        complain(str(error).strip().removesuffix("."))
        return 2


@contextlib.contextmanager
def _instead_of(name: str, module: Any) -> Iterator[None]:
    """Meanwhile, import another module under a name; None: no module has it."""
    modules: dict[str, Any] = sys.modules
    before, modules[name] = modules.get(name), module
    try:
        yield
    finally:
        del modules[name]
        if before is not None:
            modules[name] = before


def _check_environment() -> None:
    """Reject settings under which nothing can be computed, and drop those for developers of the libraries."""
    threads, interpreted = (os.environ.get(f"NUMBA_{name}", "") for name in ("NUM_THREADS", "DISABLE_JIT"))
    # No machine has 1,000 cores to use.
    if threads and not (threads.isdecimal() and len(threads) <= 3 and int(threads) > 0):
        complain(f"NUMBA_NUM_THREADS={threads[:99]} is not a number of threads; set it to 1 or more, or unset it")
        raise SystemExit(2)
    if interpreted not in ("", "0"):
        complain(f"NUMBA_DISABLE_JIT={interpreted} would leave the kernels uncompiled; unset it")
        raise SystemExit(2)
    for name in [name for name in os.environ if name.startswith(("NUMBA_", "RERUN"))]:
        if name not in ("NUMBA_NUM_THREADS", "NUMBA_CACHE_DIR"):
            del os.environ[name]
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < _FILES:
        complain(f"{hard} open files are too few; allow {_FILES} or more (ulimit -n)")
        raise SystemExit(2)
    if soft < _FILES:
        resource.setrlimit(resource.RLIMIT_NOFILE, (_FILES, hard))


def _check_names(options: Any) -> None:
    """Reject paths that cannot be file names."""
    from modeler.types import InputError

    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            _check_names(value)
        for path in value if isinstance(value, tuple | list) else (value,):
            try:
                valid = not isinstance(path, Path) or b"\0" not in os.fsencode(path)
            except UnicodeEncodeError:
                valid = False
            if not valid:
                raise InputError(f"{path}: no file can have this name; correct it")


def _exhausted(error: Exception) -> bool:
    """Return whether the system gave no more memory or threads."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOMEM, errno.EAGAIN)
    words = str(error)
    if isinstance(error, ImportError):  # as the dynamic loader words it
        return "failed to map segment" in words or "annot allocate memory" in words
    return isinstance(error, MemoryError) or "start new thread" in words


def _open_standard_streams() -> None:
    """Redirect closed standard streams to the null device, so that output does not reach the next opened file."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))


def _close_stdout() -> None:
    """Discard further output, also at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
