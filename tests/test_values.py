"""Values that hold arrays are told apart by which they are: arrays have no one truth of being equal, and no hash."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = [path for package in ("modeler", "sequences", "viz") for path in sorted((ROOT / package).rglob("*.py"))]
HOLDS_ARRAYS = re.compile(r"^(?!Callable).*(Array|ndarray)")


def comparing(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield class and annotation of fields that hold arrays and would be compared."""
    for of in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        made = " ".join(ast.unparse(decorator) for decorator in of.decorator_list)
        if "dataclass(" not in made or "eq=False" in made:
            continue
        for line in (line for line in of.body if isinstance(line, ast.AnnAssign)):
            told = ast.unparse(line)
            if HOLDS_ARRAYS.search(ast.unparse(line.annotation)) and "compare=False" not in told:
                yield of.name, told


def test_what_holds_arrays_is_not_compared_by_them() -> None:
    assert [found for path in SOURCES for found in comparing(ast.parse(path.read_text()))] == []


def test_the_scan_sees_what_it_looks_for() -> None:
    held = "@dataclass(frozen=True)\nclass Held:\n    poses: Mapping[int, Array]\n"
    assert [name for name, _ in comparing(ast.parse(held))] == ["Held"]
    assert not list(comparing(ast.parse(held.replace("frozen=True", "frozen=True, eq=False"))))
