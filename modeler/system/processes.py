"""Processes that run Python: they import what this one does, and nothing from the current folder."""

from __future__ import annotations

import os
import sys


def environment() -> dict[str, str]:
    """Return the environment in which Python finds the modules of this process, and none in the current folder."""
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(filter(os.path.isabs, sys.path))}
