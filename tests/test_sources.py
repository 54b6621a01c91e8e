"""What the sources keep to: layers, one home for each heavy library, short files, no comparison of arrays."""

import ast
import re
import tomllib
from collections.abc import Iterator

import pytest
from source_trees import ROOT, SOURCES, imported, tree

MAX_LINES = 500
HOLDS_ARRAYS = re.compile(r"^(?!Callable).*(Array|ndarray)")
HOMES = {
    "gtsam": "modeler/graph/",
    "numba": "modeler/kernels/",
    "rerun": "viz/",
    "tyro": ("modeler/cli/", "modeler/composition/"),
}


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
    long = {
        str(path.relative_to(ROOT)): lines for path in SOURCES if (lines := path.read_text().count("\n")) > MAX_LINES
    }
    assert long == {}


def comparing(module: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield class and annotation of fields that hold arrays and would be compared: arrays have no single truth."""
    for made in (node for node in ast.walk(module) if isinstance(node, ast.ClassDef)):
        decorators = " ".join(ast.unparse(decorator) for decorator in made.decorator_list)
        if "dataclass(" not in decorators or "eq=False" in decorators:
            continue
        for line in (line for line in made.body if isinstance(line, ast.AnnAssign)):
            annotated = ast.unparse(line)
            if HOLDS_ARRAYS.search(ast.unparse(line.annotation)) and "compare=False" not in annotated:
                yield made.name, annotated


def test_no_dataclass_compares_its_arrays() -> None:
    assert [found for path in SOURCES for found in comparing(tree(path))] == []


def test_comparisons_of_arrays_are_found() -> None:
    held = "@dataclass(frozen=True)\nclass Held:\n    poses: Mapping[int, Array]\n"
    assert [name for name, _ in comparing(ast.parse(held))] == ["Held"]
    assert not list(comparing(ast.parse(held.replace("frozen=True", "frozen=True, eq=False"))))


def test_public_methods_have_a_docstring_or_override_one_that_has() -> None:
    classes = {node.name: node for path in SOURCES for node in tree(path).body if isinstance(node, ast.ClassDef)}

    def documented(name: str) -> set[str]:
        """Return the methods that a class, or one it derives from, documents."""
        if name not in classes:
            return set()
        methods = [each for each in classes[name].body if isinstance(each, ast.FunctionDef)]
        own = {each.name for each in methods if ast.get_docstring(each)}
        bases = (re.split(r"[.\[]", ast.unparse(base)) for base in classes[name].bases)
        return own.union(*(documented(part) for parts in bases for part in parts))

    assert [
        f"{name}.{method.name}"
        for name in classes
        for method in classes[name].body
        if isinstance(method, ast.FunctionDef) and not (name + method.name).startswith("_")
        if not method.name.startswith("_") and method.name not in documented(name)
    ] == []


def test_classes_are_abstract_or_final() -> None:
    classes = [node for path in SOURCES for node in ast.walk(tree(path)) if isinstance(node, ast.ClassDef)]
    bases = {re.sub(r"\[.*", "", ast.unparse(base)) for node in classes for base in node.bases}
    assert bases & {node.name for node in classes if not node.name.startswith("Abstract")} == {"InputError"}
