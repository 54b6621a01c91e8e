"""Fuzzing that is led by coverage, where the library for it is installed (pip install atheris).

    python -m studies fuzz.guided tum -max_total_time=60

Takes a format of `studies.fuzz.targets` and options of libFuzzer.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from pathlib import Path


def main(arguments: list[str]) -> None:
    """Fuzz one format until libFuzzer has enough, or finds something."""
    atheris = importlib.import_module("atheris")
    with atheris.instrument_imports(include=["modeler.sequences"]):
        from modeler.types import InputError
        from studies.fuzz.targets import TARGETS, fresh
    name, *options = arguments
    target = TARGETS[name]
    folder = Path(tempfile.mkdtemp(prefix="guided"))
    path, files = fresh(target, folder / "in")
    intact = {file: file.read_bytes() for file in files}
    corpus = folder / "corpus"
    corpus.mkdir()
    for place, (_, content) in enumerate(intact.items()):
        (corpus / str(place)).write_bytes(bytes([place]) + content)

    def one(data: bytes) -> None:
        if not data:
            return
        file = files[data[0] % len(files)]
        file.write_bytes(data[1:])
        try:
            target.read(path)
        except InputError as error:
            if "\n" in str(error):
                raise AssertionError(f"not one line: {error}") from error
        finally:
            file.write_bytes(intact[file])

    atheris.Setup([sys.argv[0], str(corpus), *options], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1:])
