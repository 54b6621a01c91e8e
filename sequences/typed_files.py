"""Values of annotated types, dataclasses above all, from JSON or TOML."""

from __future__ import annotations

import re
import types
import typing
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path

from modeler.sequences.input_files import Node
from modeler.types import InputError


def build(annotation: object, node: Node) -> typing.Any:
    """Return the value that a type annotation asks for.

    Args:
        annotation: a dataclass, a union of dataclasses, None, bool, int, float, str, Path, a Literal of texts, or
            tuples of these. Paths are taken relative to the file.
        node: of the file.

    Raises:
        InputError: if a value has the wrong type or a key is unknown.
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
