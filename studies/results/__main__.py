"""Write the tables of pages on measurements, and the README's figures, from the files that hold them.

    make results

Each table is a file of studies/results/: its study, the commands that measure it, the commit at which it was measured,
columns, rows and notes. To change a figure, measure it, change its file, and write the pages anew; what stands between
the marks of a page is overwritten, the rest is prose.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from studies.results.page import PAGES, rendered
from studies.results.tables import read_all


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages."""
    parser = argparse.ArgumentParser(
        prog="python -m studies results", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(arguments)
    tables = read_all()
    for page in PAGES:
        page.write_text(rendered(page.read_text(), tables))
    return 0


if __name__ == "__main__":
    sys.exit(main())
