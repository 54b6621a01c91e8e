"""Input files and folders: opened, listed and parsed, also to annotated types, with one-line errors."""

from __future__ import annotations

import difflib
import json
import math
import os
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np

from modeler.system.regular_files import parse_json, read_regular, unreadable
from modeler.types import Array, InputError


@contextmanager
def input_errors(path: Path, what: str, advice: str) -> Iterator[None]:
    """Turn exceptions of a library on a file into one line."""
    try:
        yield
    except (InputError, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: is no complete {what} ({short_message(error, path)}); copy all of it.") from None
    except Exception as error:  # a broken file can make a library raise anything, an OSError of its own, too
        if isinstance(error, OSError) and error.errno is not None:
            raise unreadable(path, error) from None
        raise InputError(f"{path}: is not a readable {what} ({short_message(error, path)}); {advice}.") from None


def short_message(error: Exception, path: Path) -> str:
    """Return the message of an error, short and without the file's name."""
    words = " ".join(str(error).split()).replace(str(path), "the file") or type(error).__name__
    return words if len(words) <= 120 else words[:117] + "..."


def entries(folder: Path) -> list[Path]:
    """Return the contents of a folder by name; nothing without such a folder."""
    try:
        return sorted(folder.iterdir(), key=lambda path: path.name)  # whole paths take ten times as long to compare
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}); check its permissions.") from None


def is_there(path: Path) -> bool:
    """Return whether a name is taken, also by a link to nothing: what is no regular file is refused, not missed."""
    return os.path.lexists(path)


def list_images(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return the images of a folder by stem, without hidden files."""
    found: dict[str, Path] = {}
    for path in entries(folder):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        other = found.setdefault(path.stem, path)
        if other is not path:
            raise InputError(f"{path}: there is {other.name} too; remove one of them.")
    return found


def first_folder(root: Path, names: tuple[str, ...]) -> Path | None:
    """Return the first of some folders that is there."""
    return next((root / name for name in names if (root / name).is_dir()), None)


def check_link(path: Path, root: Path) -> None:
    """Refuse a path that leads out of its sequence, by a link or by its name."""
    target, home = os.path.realpath(path), os.path.realpath(root)
    if os.path.commonpath([target, home]) != home:
        raise InputError(f"{path}: leads out of the sequence, to {target}; put the file itself there.")


def listed(by: Path, name: str) -> Path:
    """Return a file that a list in the same folder names."""
    name = name.strip()
    if not name.isprintable():
        raise InputError(f"{by}: names a file with control characters; correct it there.")
    path = by.parent / name
    if Path(name).is_absolute() or ".." in Path(name).parts:
        check_link(path, by.parent)
    if not is_there(path):
        raise InputError(f"{by}: names {name}, which is not there; add it, or remove its entry.")
    return path


def check_links(root: Path) -> None:
    """Refuse a folder in which a link, at whatever depth, leads out of it, whether or not the link would be read."""

    def closed(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); check its permissions.") from None

    for folder, inner, names in os.walk(root, onerror=closed):
        for name in sorted(inner + names):
            path = Path(folder) / name
            if path.is_symlink():
                check_link(path, root)


def frame_number(stem: str) -> int | None:
    """Parse a frame number of at most nine digits; None if it is none."""
    return int(stem) if stem.isascii() and stem.isdigit() and len(stem) <= 9 else None


MAX_TEXT_BYTES = 64_000_000  # larger text is refused


_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


@dataclass(frozen=True)
class Node:
    """One value of a file, and its place in the file.

    Methods return it with the expected type, or raise an InputError that names the place.
    """

    value: object
    """The value as parsed."""
    path: Path
    """The file it comes from."""
    keys: tuple[str, ...] = ()
    """The keys that lead to it."""

    def fault(self, expected: str) -> InputError:
        """Return the error that states the expected value."""
        try:
            shown = json.dumps(self.value, default=str)
        except RecursionError:
            shown = "nested too deeply"
        shown = shown if len(shown) <= 60 else shown[:57] + "..."
        return InputError(f"{self.path}: {self.where} is {shown}; it must be {expected}.")

    def unknown(self, known: Sequence[str]) -> InputError:
        """Return the error for an entry with an unknown key."""
        near = difflib.get_close_matches(self.keys[-1], known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"it takes {', '.join(known)}."
        return InputError(f"{self.path}: {self.where} is not known; {hint}")

    @property
    def where(self) -> str:
        """The place in the file, as in `"0"."cam_K"`."""
        return ".".join(json.dumps(key) for key in self.keys) or "the top level"

    def items(self) -> dict[str, Node]:
        """Return the entries of an object."""
        if not isinstance(self.value, dict):
            raise self.fault('an object {"key": value, ...}')
        return {str(key): Node(value, self.path, (*self.keys, str(key))) for key, value in self.value.items()}

    def frames(self) -> dict[int, Node]:
        """Return the entries of an object whose keys are frame numbers."""
        found: dict[int, Node] = {}
        for key, node in self.items().items():
            number = frame_number(key)
            if number is None:
                shown = json.dumps(key if len(key) <= 40 else key[:37] + "...")
                raise InputError(f'{self.path}: key {shown} is not a frame number; use keys such as "0".')
            found[number] = node
        return found

    def elements(self) -> list[Node]:
        """Return the elements of a list."""
        if not isinstance(self.value, list):
            raise self.fault("a list [...]")
        return [Node(value, self.path, (*self.keys, str(i))) for i, value in enumerate(self.value)]

    def get(self, key: str) -> Node | None:
        """Return one entry of an object; None if it is absent or null."""
        node = self.items().get(key)
        return None if node is None or node.value is None else node

    def need(self, key: str) -> Node:
        """Return one entry of an object that must be there."""
        node = self.get(key)
        if node is None:
            raise InputError(f"{self.path}: {self.where} lacks {json.dumps(key)}; add it.")
        return node

    def text(self) -> str:
        """Return a string that is not empty, without control characters, which steer terminals, and lone surrogates."""
        if not isinstance(self.value, str) or not self.value.strip() or _UNPRINTABLE.search(self.value):
            raise self.fault("a printable text that is not empty")
        return self.value

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a finite number between `low` and `high`, both included."""
        expected = "a finite number"
        if math.isfinite(low) or math.isfinite(high):
            expected = f"a number of at least {low:g}" if math.isinf(high) else f"a number from {low:g} to {high:g}"
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.fault(expected)
        try:
            number = float(self.value)
        except OverflowError:
            raise self.fault(expected) from None
        if not (math.isfinite(number) and low <= number <= high):
            raise self.fault(expected)
        return number

    def rotation(self) -> Array:
        """Return a rotation matrix (3, 3), row by row in a list: the one nearest to its rounded digits."""
        written = self.numbers(9).reshape(3, 3)
        left, stretch, right = np.linalg.svd(np.clip(written, -2.0, 2.0))
        if np.abs(stretch - 1.0).max() > 1e-2 or np.linalg.det(left @ right) < 0.0:
            raise self.fault("a rotation matrix, row by row")
        return left @ right

    def numbers(self, count: int) -> Array:
        """Return a list of exactly `count` finite numbers (count,)."""
        expected = f"a list of {count} finite numbers"
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.fault(expected)
        try:
            return np.array([element.number() for element in self.elements()])
        except InputError:
            raise self.fault(expected) from None


def read_tree(path: Path) -> Node:
    """Parse a JSON file, or a TOML or YAML file by its suffix."""
    kind = {".toml": "TOML", ".yaml": "YAML", ".yml": "YAML"}.get(path.suffix.lower(), "JSON")
    text = read_text(path, kind)
    if kind == "JSON":
        return Node(parse_json(text, path), path)
    try:
        return Node(tomllib.loads(text) if kind == "TOML" else _from_yaml(text), path)
    except (ValueError, RecursionError) as error:
        why = "nested too deeply" if isinstance(error, RecursionError) else short_message(error, path)
    raise InputError(f"{path}: is not valid {kind} ({why}); correct it there.")


def _from_yaml(text: str) -> object:
    """Parse YAML, also OpenCV's, which states version and types in ways of its own."""
    from ruamel.yaml import YAML  # takes 30 ms

    if len(text) > 1_000_000:  # the parser takes a minute for so many characters; cameras take two thousand
        raise ValueError("it is larger than files of cameras are")
    text = re.sub(r"\A%YAML:.*\n", "", text.lstrip())
    try:
        documents = YAML(typ="safe", pure=True).load_all(re.sub(r"!!opencv-\w+", "", text))
        return next(iter(documents), None)
    except RecursionError:
        raise
    except Exception as error:  # broken files make the library raise anything
        raise ValueError(" ".join(str(error).split())) from None


def read_text(path: Path, kind: str = "text") -> str:
    """Return the text of a file of at most 64 MB."""
    try:
        return read_regular(path, MAX_TEXT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start}); save it as {kind}.") from None


def build(annotation: object, node: Node) -> typing.Any:
    """Return the value that a type annotation asks for.

    Args:
        annotation: a dataclass, a union of dataclasses, None, bool, int, float, str, Path, a Literal of texts, or
            tuples of these. Paths are taken relative to the file.
        node: of the file.
    """
    origin, choices = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return _one_of(choices, node)
    if origin is tuple:
        return _tuple(choices, node)
    if origin is typing.Literal:
        if node.value not in choices:
            raise node.fault("one of " + ", ".join(f'"{choice}"' for choice in choices))
        return node.value
    if isinstance(annotation, type) and is_dataclass(annotation):
        return _dataclass(annotation, node)
    if annotation is float:
        return node.number()
    if annotation is int or annotation is bool:
        if type(node.value) is not annotation:
            raise node.fault("true or false" if annotation is bool else "a whole number")
        return node.value
    if annotation is Path:
        return node.path.parent / node.text()
    if annotation is str:
        return node.text()
    raise TypeError(f"no value of type {annotation!r} can be read from a file")


def kind_of(cls: type) -> str:
    """Return the name of a dataclass in files: `MeshFile` is "mesh_file"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()


def _one_of(choices: tuple[object, ...], node: Node) -> object:
    if node.value is None and type(None) in choices:
        return None
    some = [choice for choice in choices if choice is not type(None)]
    if len(some) == 1:
        return build(some[0], node)
    kinds = {kind_of(choice): choice for choice in some if isinstance(choice, type)}
    said = node.items().get("kind")
    if said is None or not isinstance(said.value, str) or said.value not in kinds:
        place = node if said is None else said
        raise place.fault(('an object with "kind" ' if said is None else "") + "one of " + ", ".join(kinds))
    return build(kinds[said.value], node)


def _tuple(choices: tuple[object, ...], node: Node) -> tuple[object, ...]:
    elements = node.elements()
    if len(choices) == 2 and choices[1] is Ellipsis:
        return tuple(build(choices[0], element) for element in elements)
    if len(elements) != len(choices):
        raise node.fault(f"a list of {len(choices)} values")
    return tuple(build(choice, element) for choice, element in zip(choices, elements, strict=True))


def _dataclass(cls: type, node: Node) -> object:
    items, hints = node.items(), typing.get_type_hints(cls)
    known = {field.name: field for field in fields(cls)}
    for key, entry in items.items():
        if key not in known and not (key == "kind" and entry.value == kind_of(cls)):
            raise entry.unknown(tuple(known))
    values = {key: build(hints[key], entry) for key, entry in items.items() if key in known}
    for name, entry in known.items():
        if name not in values and entry.default is MISSING and entry.default_factory is MISSING:
            node.need(name)
    try:
        return cls(**values)
    except ValueError as error:
        raise InputError(f"{node.path}: {node.where}: {error}.") from None
