"""Write docs/results.md and the README's line of figures from the files that hold their figures.

    make results

Each table is a file of studies/results/: its study, the commands that measure it, the commit at which it was
measured, columns, rows and notes. The prose between the tables is studies/results/page.md. To change a figure, measure
it, change its file, and write the pages anew.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from studies.results.page import PAGE, README, readme, rendered
from studies.results.tables import read_all


def main(arguments: Sequence[str] | None = None) -> int:
    """Write both pages."""
    parser = argparse.ArgumentParser(
        prog="python -m studies results", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(arguments)
    tables = read_all()
    PAGE.write_text(rendered(tables))
    README.write_text(readme(README.read_text(), tables))
    return 0


if __name__ == "__main__":
    sys.exit(main())
