"""Results of a study that was interrupted."""

from __future__ import annotations

import sys
from pathlib import Path


def earlier_results(path: Path) -> list[str]:
    """Return the lines of a study's file, and say on stderr how many there are: other code may have made them."""
    lines = path.read_text().splitlines() if path.exists() else []
    if lines:
        print(f"{path}: {len(lines)} results are kept; choose another --out to measure all anew", file=sys.stderr)
    return lines
