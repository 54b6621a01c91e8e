"""`modeler render`: synthetic sequences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from modeler.composition.options import SEED, default


@dataclass(frozen=True)
class Render:
    """Render a synthetic sequence, with its ground truth, from a recipe."""

    recipe: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RECIPE")]
    """Recipe in JSON or TOML, or the name of a built-in one: box, flashlight, tube and more."""
    out: Annotated[Path, tyro.conf.arg(metavar="SEQUENCE")]
    """BOP scene folder to create."""
    seed: Annotated[int | None, SEED, default("the recipe's own")] = None
    """Seed of the camera's noise and of the object's motion."""

    def run(self) -> int:
        """Render the sequence."""
        from modeler.cli.reading import reading
        from modeler.runs.outputs import check_folder
        from modeler.sequences.rendering.recipe import load_recipe
        from modeler.sequences.rendering.renderer import render

        check_folder(self.out, [Path(self.recipe)])
        recipe = load_recipe(self.recipe)
        with reading() as watched:
            render(recipe if self.seed is None else replace(recipe, seed=self.seed), self.out, watched)
        return 0
