"""Optional packages: whether one is there, and how to get it."""

from __future__ import annotations

import importlib.util
import shlex
import sys

from modeler.types import InputError


def install_command(extra: str) -> str:
    """Return the command that installs an extra for the interpreter that runs, of a clone and of a package alike."""
    return f"{shlex.quote(sys.executable)} -m pip install 'modeler[{extra}]'"


def check_installed(module: str, package: str, extra: str) -> None:
    """Reject work that needs a package that is not installed.

    Raises:
        InputError: if it is not installed.
    """
    if importlib.util.find_spec(module) is None:
        raise InputError(f"{package} is not installed; {install_command(extra)}")
