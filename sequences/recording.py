"""Sequences that lie on a disk, and the `sequence.json` beside them that says more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from modeler.types import InputError
from sequences.base import AbstractSequence, span
from sequences.files.folders import inside
from sequences.files.json_input import Node, read_tree


@dataclass(frozen=True)
class AbstractRecording(AbstractSequence):
    """A sequence in a folder or a file, of whatever format.

    What the format cannot say stands in `sequence.json` of the folder, or in `NAME.json` beside a file `NAME.bag`.
    """

    path: Path
    """The folder or the file."""

    @property
    def name(self) -> str:
        """What the sequence is called: as `sequence.json` says, else as the folder or file."""
        node = None if self._meta is None else self._meta.get("name")
        resolved = self.path.resolve()
        return (resolved.name if self._is_folder else resolved.stem) if node is None else node.text()

    def sensor(self) -> tuple[float, float] | None:
        """Return `(sigma_wh, sigma_r_m)` from `sequence.json`; None where it does not say."""
        node = None if self._meta is None else self._meta.get("sensor")
        if node is None:
            return None
        return node.need("sigma_wh").number(1e-9, 1.0), node.need("sigma_r_m").number(1e-9, 10.0)

    @property
    def motion(self) -> Mapping[str, object] | None:
        """What `sequence.json` says of the motion; None where it says nothing."""
        node = None if self._meta is None else self._meta.get("motion")
        return None if node is None else {key: entry.value for key, entry in node.items().items()}

    @property
    def robot_path(self) -> Path | None:
        """`robot.txt`, where there is one."""
        return self._beside("robot.txt")

    @property
    def model_path(self) -> Path | None:
        """`model.ply`, where there is one: the true surface in m."""
        return self._beside("model.ply")

    def absent(self, index: int) -> InputError:
        """Return the error that says that there is no frame of that number."""
        return InputError(f"{self.path}: has no frame {index}; its frames are {span(self.indices)}.")

    def _beside(self, name: str) -> Path | None:
        """Return a file in the folder, where there is one; one to which a link leads out of it is refused."""
        path = self.path / name
        return inside(path, self.path) if self._is_folder and path.is_file() else None

    @cached_property
    def _is_folder(self) -> bool:
        return self.path.is_dir()

    @cached_property
    def _meta(self) -> Node | None:
        path = inside(self.path / "sequence.json", self.path) if self._is_folder else self.path.with_suffix(".json")
        return read_tree(path) if path.is_file() else None
