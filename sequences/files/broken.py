"""What libraries say of broken files, in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from modeler.types import InputError


@contextmanager
def told(path: Path, what: str, advice: str) -> Iterator[None]:
    """Turn whatever a library raises at a file into one line.

    Args:
        path: the file.
        what: what it should be, as in "bag".
        advice: what to do where it is none.

    Raises:
        InputError: in place of anything else.
    """
    try:
        yield
    except (InputError, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: is no complete {what} ({said(error, path)}); copy all of it.") from None
    except OSError as error:
        why = error.strerror or said(error, path)
        raise InputError(f"{path}: cannot be read ({why}); check the path and its permissions.") from None
    except Exception as error:  # a broken file can make a library raise anything
        raise InputError(f"{path}: is not a readable {what} ({said(error, path)}); {advice}.") from None


def said(error: Exception, path: Path) -> str:
    """Return what an error says, short and without the file's name."""
    words = " ".join(str(error).split()).replace(str(path), "the file") or type(error).__name__
    return words if len(words) <= 120 else words[:117] + "..."
