"""What is sent to a recording: archetypes by the path of their entity."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import rerun as rr

Drawing = Iterator[tuple[str, rr.AsComponents]]
"""Entities in the order in which they are logged."""

CLEAR: Final = rr.Clear(recursive=False)
"""Takes away what an entity showed."""
