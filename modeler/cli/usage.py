"""Arguments to a command. Wrong usage is told in one line."""

import contextlib
import io
import re
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import metadata
from itertools import groupby
from typing import Annotated, Any, Union

import tyro

from modeler.cli.build import Build
from modeler.cli.calibrate_sensor import CalibrateSensor
from modeler.cli.convert import Convert
from modeler.cli.evaluate import Evaluate
from modeler.cli.export import Export
from modeler.cli.info import Info
from modeler.cli.join import Join
from modeler.cli.register import Register
from modeler.cli.render import Render
from modeler.cli.report import Report
from modeler.cli.saying import say
from modeler.cli.view import View

Command = Build | Info | Convert | CalibrateSensor | Register | Evaluate | Render | View | Report | Export | Join

_COMMANDS: dict[str, type[Command]] = {
    "build": Build,
    "info": Info,
    "convert": Convert,
    "calibrate-sensor": CalibrateSensor,
    "register": Register,
    "evaluate": Evaluate,
    "render": Render,
    "view": View,
    "report": Report,
    "export": Export,
    "join": Join,
}
_STYLE = (
    tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.DisallowNone,
)
_HELP_INDENT = " " * 8  # deeper than what went wrong stands the help of an option
_REWORDED = (
    (r" \(applied to modeler [a-z-]+\)", ""),
    (r" Arguments are applied to the directly preceding subcommand, so ordering can matter", ""),
    (r"; For full helptext, .*", ""),
    (r"Unrecognized options: (-[^,;]+).*; Available subcommands: ", r"unknown before a command: \1; commands are "),
    (
        r"Unrecognized options: ([^,;]+).*; Available subcommands: ",
        lambda found: f"there is no command '{found[1]}'{_meant(found[1])}; there are ",
    ),
    (r"Unrecognized (?:or misplaced )?options: ([^;]*)", lambda found: f"unknown: {found[1].strip().replace(',', '')}"),
    (r"Perhaps you meant: ([^;]*)", r"perhaps you meant \1"),
    (r"Missing from modeler [a-z-]+: ", "missing: "),
    (r"Missing value for argument '(\S+)'\. .*", r"\1 lacks its value"),
    (r"Expected one of \{(.*)\}", r"give a command: \1"),
    (r"Error parsing (\S+): takes ", r"\1 takes "),
    (r"Error parsing (\S+): no type matching \{?(.*?)\}? could be .* from \[(.*?)\]\. .*", r"\1 takes \2, not \3"),
    (r"Error parsing (\S+): invalid literal for int\(\) with base 10: (.*)", r"\1 takes INT, not \2"),
    (r"'None', |, 'None'", ""),  # an option that may be left out
    (r"invalid choice '(\S*)' for argument '(\S+)'\. Expected one of \((.*?)\)", r"\2 takes \3, not '\1'"),
    (r"\b(?:INT|FLOAT)(?: (?:INT|FLOAT))+\b", lambda found: f"{len(found[0].split())} numbers"),
    (r"\bINT\b", "a whole number"),
    (r"\bFLOAT\b", "a number"),
)
"""From the parser's words to ours."""
_DESCRIPTION = (
    "Object models from depth-camera sequences. Data goes to stdout, progress and messages to stderr. --version tells "
    "which version this is."
)


def parsed(arguments: Sequence[str]) -> Command:
    """Return the command that the arguments (after the program's name) ask for.

    Raises:
        SystemExit: with status 0 after help or version, with 2 and one line on stderr for what is no command.
    """
    if list(arguments[:1]) == ["help"]:
        arguments = [*(name for name in arguments[1:2] if name in _COMMANDS), "--help"]
    if list(arguments) == ["--version"]:
        print(f"modeler {metadata.version('modeler')}")
        raise SystemExit(0)
    complaint = io.StringIO()
    asked = next((name for name in arguments[:1] if name in _COMMANDS), None)
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                _choice(brief=asked is None), prog="modeler", description=_DESCRIPTION, args=arguments, config=_STYLE
            )
    except SystemExit as ending:
        if ending.code:
            named = "" if asked is None else f"{asked} "
            say(f"{_one_line(complaint.getvalue(), named)}; see modeler {named}--help")
        raise


def _choice(*, brief: bool) -> Any:
    """Return the type that is any of the commands, each told of by its first sentence alone, or by all that it says."""
    return Union[  # noqa: UP007
        tuple(
            Annotated[kind, tyro.conf.subcommand(name, description=_first_paragraph(kind) if brief else None)]
            for name, kind in _COMMANDS.items()
        )
    ]


def _first_paragraph(kind: type[Command]) -> str:
    return (kind.__doc__ or "").split("\n\n", maxsplit=1)[0]


def _one_line(box: str, asked: str) -> str:
    """Return the words of the parser's drawn box, without its title, frame, quoted help and colours.

    Args:
        box: what the parser drew.
        asked: command that was asked for, and a space; empty without one.
    """
    text = re.sub(r"\x1b\[[0-9;]*m|\[/?bold\]|<class '\w+'>: ", "", box)
    rows = [row.strip("│|╭╮╰╯").rstrip() for row in text.splitlines()][1:]
    rows = [re.sub(r"^ +in modeler (\S+) --help", r"(\1)", row) for row in rows]
    # Which commands have what was perhaps meant is of interest only where the one asked for has not.
    beside = (_HELP_INDENT, "(") if f"({asked.strip()})" in rows else _HELP_INDENT
    rows = [row for row in rows if not row.startswith(beside)]
    parts = [" ".join(" ".join(group).split()) for ruler, group in groupby(rows, _is_ruler) if not ruler]
    line = "; ".join(part.rstrip(".") for part in parts if part and not part.startswith("Argument helptext"))
    for words, ours in _REWORDED:
        line = re.sub(words, ours, line)
    return line.replace(") (", ", ")


def _meant(name: str) -> str:
    """Return in words which command is called nearly that, "" where none is."""
    return "".join(f", perhaps you meant {near}" for near in get_close_matches(name, _COMMANDS, n=1))


def _is_ruler(row: str) -> bool:
    return bool(row) and not row.strip("─+- ")
