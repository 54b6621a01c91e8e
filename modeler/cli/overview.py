"""The commands by name, each in a sentence: help of the program, which appears without importing any of them."""

from __future__ import annotations

import importlib
import shutil
import textwrap
from typing import Final, Protocol

from modeler.cli import messages

_DESCRIPTION: Final = (
    "Object models from depth-camera sequences. Data goes to stdout, progress and messages to stderr. "
    f"--version prints the version. {messages.HELP}"
)
_WIDEST: Final = 120  # columns of text, which no one reads wider


class Command(Protocol):
    """A frozen dataclass of options."""

    def run(self) -> int:
        """Return the exit status."""
        ...


SUMMARIES: Final = {
    "build": "Build the model of an object from a sequence: register its frames, close loops, fuse.",
    "batch": (
        "Build models of many sequences, each into its own run folder below DIR, and list them in DIR/models.parquet."
    ),
    "info": (
        "Describe the input at a path: format, frames, resolution, depth, intrinsics, masks, colour, what is missing."
    ),
    "convert": "Write any input as a BOP scene folder, the native layout; or the poses of a run for other programs.",
    "calibrate-sensor": (
        "Measure a depth camera's noise, across and along the ray, from a few frames of a static scene."
    ),
    "calibrate-camera": (
        "Estimate a depth camera's focal length from a run in which the object came back to its first view."
    ),
    "register": "Register two frames of a sequence and print target_from_source as a JSON edge.",
    "evaluate": "Register pairs of frames with known true motion by several methods, and report their errors.",
    "render": "Render a synthetic sequence, with its ground truth, from a recipe.",
    "view": "Open the recording of a run in the Rerun viewer.",
    "report": (
        "Write one HTML page about a run: model, trajectory, uncertainty, errors, pairs, settings. It needs no network."
    ),
    "export": "Write the fused mesh of a run as PLY, OBJ, GLB, STL or 3MF, in m.",
    "track": (
        "Find an object in new images with its model, and follow it: poses with covariance, or that it is not there."
    ),
    "join": "Join two runs of the same object in different postures, so that the model has no hidden side.",
    "edit": "Take frames out of a finished run, and optimise and fuse the rest without registering again.",
    "suggest": "Suggest what to do next: the turn, poke or view with the most information on poses and surface.",
    "gallery": (
        "Write one HTML page about the models in a folder: pictures and values, to sort and filter. It needs no "
        "network."
    ),
    "studio": "Make models in the browser: open captures, mark the object, build, check, export; on 127.0.0.1 only.",
}
"""The first sentence of each command's description, in the order in which help lists them."""
_MODULES: Final = {
    "info": "convert",
    "register": "evaluate",
    "render": "convert",
    "calibrate-sensor": "calibrate",
    "calibrate-camera": "calibrate",
    "join": "edit",
    "suggest": "edit",
    "view": "pages",
    "report": "pages",
    "gallery": "pages",
    "studio": "pages",
}
"""Of commands that share a module with another; the others have one of their own name."""


def command_class(name: str) -> type[Command]:
    """Return the command of a name; only its module is imported."""
    module = importlib.import_module(f"modeler.cli.{_MODULES.get(name, name)}")
    return getattr(module, name.title().replace("-", ""))


def overview() -> str:
    """Return the help of the program, as wide as the terminal."""
    width = max(min(shutil.get_terminal_size().columns, _WIDEST), 40)
    column = 4 + max(map(len, SUMMARIES))

    def filled(text: str, lead: str = "", margin: int = 0) -> str:
        return textwrap.fill(text, width, initial_indent=lead, subsequent_indent=" " * margin) + "\n"

    commands = "".join(filled(summary, f"  {name}".ljust(column), column) for name, summary in SUMMARIES.items())
    return (
        "usage: modeler COMMAND [OPTIONS]\n\n"
        f"{filled(_DESCRIPTION)}\ncommands (modeler COMMAND --help describes one in full):\n{commands}"
    )
