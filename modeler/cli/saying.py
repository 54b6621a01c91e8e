"""Words on stderr, where messages go."""

import sys


def say(words: str) -> None:
    """Tell a person something in one line; names in inputs shall not steer the terminal."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(words.split()))
    print("modeler:", line, file=sys.stderr)
