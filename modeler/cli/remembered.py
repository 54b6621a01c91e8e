"""Registrations of an interrupted run, taken up by the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from modeler.types import AbstractMotion, AbstractRegistrar, Posterior, RayImage


@final
@dataclass(frozen=True, eq=False)
class Remembered(AbstractRegistrar):
    """Answers what is known from memory and asks another registrar for the rest."""

    registrar: AbstractRegistrar
    """Asked where memory ends."""
    known: Mapping[tuple[int, int], Posterior]
    """Posteriors by (source, target)."""

    def register(
        self, source: RayImage, target: RayImage, motion: AbstractMotion, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source."""
        known = self.known.get((source.index, target.index))
        return self.registrar.register(source, target, motion, rng=rng) if known is None else known
