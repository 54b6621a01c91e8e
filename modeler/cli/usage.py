"""Arguments to a command. Wrong usage is told in one line."""

import contextlib
import io
import re
import sys
from collections.abc import Sequence
from itertools import groupby
from typing import Annotated

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
from modeler.cli.view import View

Command = (
    Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[CalibrateSensor, tyro.conf.subcommand("calibrate-sensor")]
    | Annotated[Register, tyro.conf.subcommand("register")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Join, tyro.conf.subcommand("join")]
)

_STYLE = (
    tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.DisallowNone,
)
_HELP_INDENT = " " * 8  # deeper than what went wrong stands the help of an option
_DESCRIPTION = "Object models from depth-camera sequences. Data goes to stdout, progress and messages to stderr."


def parsed(
    arguments: Sequence[str],
) -> Build | Info | Convert | CalibrateSensor | Register | Evaluate | Render | View | Report | Export | Join:
    """Return the command that the arguments (after the program's name) ask for.

    Raises:
        SystemExit: with status 0 after help, with 2 and one line on stderr for arguments that are no command.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Command, prog="modeler", description=_DESCRIPTION, args=arguments, config=_STYLE)  # pyright: ignore[reportReturnType, reportArgumentType]
    except SystemExit as ending:
        if ending.code:
            print(f"modeler: {_one_line(complaint.getvalue())}", file=sys.stderr)
        raise


def _one_line(box: str) -> str:
    """Return the words of the parser's drawn box, without its title, frame, quoted help and colours."""
    text = re.sub(r"\x1b\[[0-9;]*m|\[/?bold\]|<class '\w+'>: ", "", box)
    rows = [row.strip("│|╭╮╰╯").rstrip() for row in text.splitlines()][1:]
    rows = [row for row in rows if not row.startswith(_HELP_INDENT)]
    parts = [" ".join(" ".join(group).split()) for ruler, group in groupby(rows, _is_ruler) if not ruler]
    return "; ".join(part.rstrip(".") for part in parts if part and not part.startswith("Argument helptext"))


def _is_ruler(row: str) -> bool:
    return bool(row) and not row.strip("─+- ")
