"""Count the named numbers of the package by room: `python -m studies numbers [--list ROOM...]`.

A number is a name bound at module level, or a field's default, whose expression has a literal number other than 0; not
those that give only the shape of an empty array.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence

from studies.ablation.constants.source import Number, all_numbers
from studies.results.tables import markdown


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the count of each room, or list the numbers of some."""
    parser = argparse.ArgumentParser(
        prog="numbers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", nargs="+", metavar="ROOM", default=(), help="list the numbers of these rooms")
    options = parser.parse_args(arguments)
    found = all_numbers()
    for number in found:
        if number.room in options.list:
            print(f"{number.key}:{number.line} = {number.value}")
    if not options.list:
        print(table(found))
    return 0


def table(numbers: Sequence[Number]) -> str:
    """Return the counts by room, in Markdown: constants of modules, defaults of fields, and both."""
    rooms = Counter(number.room for number in numbers)
    fields = Counter(number.room for number in numbers if "." in number.name)
    rows = [(room, count - fields[room], fields[room], count) for room, count in rooms.most_common()]
    whole = ("all", len(numbers) - fields.total(), fields.total(), len(numbers))
    return markdown(("room", "constants", "fields", "numbers"), [*rows, whole])


if __name__ == "__main__":
    sys.exit(main())
