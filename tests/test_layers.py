"""Where things live: every module has a layer, each heavy library one home, and files stay small."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from sources import ROOT, SOURCES, nodes

HOMES = {"gtsam": "modeler/graph/", "numba": "modeler/kernels/", "rerun": "viz/", "tyro": "modeler/cli/"}


def imported(path: Path) -> Iterator[str]:
    """Yield the top-level names that a file imports anywhere in it."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (name.name.partition(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            yield node.module.partition(".")[0]


@pytest.mark.parametrize("library", HOMES)
def test_each_heavy_library_has_one_home(library: str) -> None:
    homes = {str(path.relative_to(ROOT)) for path in SOURCES if library in imported(path)}
    assert homes
    assert [home for home in homes if not home.startswith(HOMES[library])] == []


def test_every_module_has_a_layer() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layered = {name.strip() for contract in contracts for row in contract.get("layers", []) for name in row.split("|")}
    parts = {
        path.stem for path in (ROOT / "modeler").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert {f"modeler.{part}" for part in parts - {"__init__", "__main__"}} <= layered


def test_no_file_is_long() -> None:
    long = {str(path.relative_to(ROOT)): lines for path in SOURCES if (lines := path.read_text().count("\n")) > 300}
    assert long == {}
