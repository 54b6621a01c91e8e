"""The named numbers of a package, read from its source, and the package with one of them changed."""

from __future__ import annotations

import ast
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final, final

import numpy as np

PACKAGE: Final = Path(__file__).resolve().parents[3] / "modeler"
_UNITS: Final = ("_M", "_PX", "_RAD", "_DEG", "_NATS", "_SIGMAS", "_SIGMA", "_SIZES")  # of numbers that are no shares
_SCALE: Final = "_number_of_study"


@final
@dataclass(frozen=True, order=True)
class Number:
    """One named number: a constant of a module, or the default of a field."""

    module: str
    """Its dotted name."""
    name: str
    """`_NAME`, or `Class.field`."""
    line: int
    """Where it stands, from 1."""
    value: str
    """Its expression."""

    @property
    def room(self) -> str:
        """The folder of its module, or `.`."""
        parts = self.module.split(".")
        return parts[1] if len(parts) > 2 else "."

    @property
    def key(self) -> str:
        """What names it."""
        return f"{self.module.removeprefix('modeler.')}.{self.name}"


def files(package: Path = PACKAGE) -> Iterator[tuple[str, Path]]:
    """Yield the modules of a package, those of linked folders included, with their dotted names."""
    for path in sorted(package.iterdir()):
        if path.suffix == ".py":
            yield f"{package.name}.{path.stem}", path
        elif (path / "__init__.py").exists():
            for inner, file in files(path.resolve()):
                yield f"{package.name}.{inner}", file


def numbers_in(module: str, text: str) -> list[Number]:
    """Return the numbers of a module, in the order of its source.

    A number is a name bound at module level, or a field of a class bound by default, to an expression with a number
    other than 0, not counting shapes of empty arrays. A tuple that is unpacked into names has one for each name.
    """
    found = []
    for statement in ast.parse(text).body:
        inner = statement.body if isinstance(statement, ast.ClassDef) else [statement]
        prefix = f"{statement.name}." if isinstance(statement, ast.ClassDef) else ""
        for one in inner:
            found += [
                Number(module, prefix + name, one.lineno, ast.unparse(value))
                for name, value in _bound(one)
                if any(_counts(node.value) for node in _literals(value))
            ]
    return found


def all_numbers(package: Path = PACKAGE) -> list[Number]:
    """Return the numbers of all modules of a package."""
    return [number for module, path in files(package) for number in numbers_in(module, path.read_text())]


def _literals(value: ast.expr) -> Iterator[ast.Constant]:
    """Yield the constants of an expression, but for shapes of arrays of zeros, of ones, and of identity."""
    if isinstance(value, ast.Call) and ast.unparse(value.func) in ("np.zeros", "np.ones", "np.eye"):
        return
    if isinstance(value, ast.Constant):
        yield value
    for child in ast.iter_child_nodes(value):
        yield from _literals(child)  # pyright: ignore[reportArgumentType]


def _counts(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value != 0


def _bound(statement: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    """Yield the names that a statement binds, each with its expression."""
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value is not None:
        yield statement.target.id, statement.value
    elif isinstance(statement, ast.Assign):
        for target in statement.targets:
            if isinstance(target, ast.Name):
                yield target.id, statement.value
            elif isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
                for name, value in zip(target.elts, statement.value.elts, strict=True):
                    if isinstance(name, ast.Name):
                        yield name.id, value


def changed(text: str, number: Number, factor: float) -> str:
    """Return the source of a number's module with the number times a factor."""
    tree = ast.parse(text)
    owner, _, name = number.name.rpartition(".")
    body = tree.body
    for statement in tree.body:
        if isinstance(statement, ast.ClassDef) and statement.name == owner:
            body = statement.body
    for statement in body:
        for bound, value in _bound(statement):
            if bound == name:
                _replace(statement, value, _scaled(value, factor, share=not name.upper().endswith(_UNITS)))
    head = f"from {__name__} import times as {_SCALE}"
    place = next(k for k, one in enumerate(tree.body) if not _is_docstring(one) and not _is_future(one))
    tree.body.insert(place, ast.parse(head).body[0])
    return ast.unparse(ast.fix_missing_locations(tree))


def _is_docstring(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _is_future(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.ImportFrom) and statement.module == "__future__"


def _replace(statement: ast.stmt, old: ast.expr, new: ast.expr) -> None:
    for node in ast.walk(statement):
        for field, value in ast.iter_fields(node):
            if value is old:
                setattr(node, field, new)
            elif isinstance(value, list) and old in value:
                value[value.index(old)] = new


def _scaled(value: ast.expr, factor: float, *, share: bool) -> ast.expr:
    """Return an expression times a factor: of a function of one number, that number; of one minus it, it."""
    if isinstance(value, ast.Call) and ast.unparse(value.func) in ("field", "float", "np.array"):
        keywords = [
            ast.keyword(one.arg, _scaled(one.value, factor, share=share)) if one.arg == "default" else one
            for one in value.keywords
        ]
        return ast.Call(value.func, [_scaled(one, factor, share=share) for one in value.args], keywords)
    if isinstance(value, ast.Call) and len(value.args) == 1 and ast.unparse(value.func).startswith("np."):
        return ast.Call(value.func, [_scaled(value.args[0], factor, share=False)], value.keywords)
    if isinstance(value, ast.BinOp) and isinstance(value.op, ast.Sub) and ast.unparse(value.left) == "1.0":
        return ast.BinOp(value.left, value.op, _scaled(value.right, factor, share=False))
    name = ast.Name(_SCALE, ast.Load())
    return ast.Call(name, [value, ast.Constant(factor), ast.Constant(share)], [])


def times(value: Any, factor: float, share: bool) -> Any:
    """Return a number, or numbers, times a factor; whole ones stay whole, and positive.

    A share from 0.5 to 1 that is to be doubled moves half of the way to 1, as twice as much is out of range.
    """
    if isinstance(value, dict):
        return {key: times(one, factor, share) for key, one in value.items()}
    if isinstance(value, tuple):
        return tuple(times(one, factor, share) for one in value)
    if isinstance(value, np.ndarray):
        return (value * factor).astype(value.dtype)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    if isinstance(value, int):
        return max(round(value * factor), 1) if value > 0 else value
    return 0.5 * (1.0 + value) if share and factor > 1.0 and 0.5 <= value < 1.0 else value * factor


@dataclass
class _Finder(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Loads one module from changed source."""

    number: Number
    text: str
    path: Path

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """Return the specification of the changed module only."""
        if fullname != self.number.module:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, origin=str(self.path))

    def get_source(self, fullname: str) -> str:
        """Return the changed source."""
        return self.text


def put_in_place(number: Number, factor: float, users: Sequence[str]) -> None:
    """Make all modules of this process that depend on a number be imported again, with the number times a factor.

    For a process that ends thereafter: objects of the old modules stay what they are.

    Args:
        number: to change.
        factor: of it.
        users: other packages whose modules depend on the number's, such as those of the study.
    """
    path = dict(files())[number.module]
    for module in dependents(number.module, users):
        if module in sys.modules:
            del sys.modules[module]
            parent, _, name = module.rpartition(".")
            if parent in sys.modules and name in vars(sys.modules[parent]):
                delattr(sys.modules[parent], name)
    sys.meta_path.insert(0, _Finder(number, changed(path.read_text(), number, factor), path))


def dependents(module: str, users: Sequence[str] = ()) -> set[str]:
    """Return a module and all that import it, directly or not, and the given others."""
    found = {module}
    while more := {name for name, imported in imports().items() if name not in found and imported & found}:
        found |= more
        found |= {name.removesuffix(".__init__") for name in more}
    return (found | set(users)) - {"modeler", "modeler.__init__"}


@cache
def imports() -> Mapping[str, set[str]]:
    """Return what each module imports."""
    return {name: _imported(path.read_text()) for name, path in files()}


def _imported(text: str) -> set[str]:
    """Return the modules that a source imports, and what may be modules."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found - {"modeler"}  # whose names are imported when they are used
