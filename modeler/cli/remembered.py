"""Registrations of an interrupted run, taken up by the next."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from modeler.export import Pairs
from modeler.types import AbstractPoseDensity, AbstractRegistrar, Posterior, RayImage

_DRAWN = 64  # motions by which one prior is told from another


@final
@dataclass(frozen=True, eq=False)
class Remembered(AbstractRegistrar):
    """Answers what is known from memory, asks another registrar for the rest, and keeps what it says at once."""

    registrar: AbstractRegistrar
    """Asked where memory ends."""
    pairs: Pairs
    """The memory."""
    versions: Mapping[str, str]
    """Of the packages: with others, answers may be others."""

    def register(
        self, source: RayImage, target: RayImage, density: AbstractPoseDensity, *, rng: np.random.Generator
    ) -> Posterior:
        """Return the posterior of target_from_source."""
        question = self._question((source, target), density, rng)
        known = self.pairs.get(source.index, target.index, question)
        if known is not None:
            return known
        found = self.registrar.register(source, target, density, rng=rng)
        self.pairs.keep(found, question)
        return found

    def _question(
        self, views: tuple[RayImage, RayImage], density: AbstractPoseDensity, rng: np.random.Generator
    ) -> str:
        """Return a digest of all that an answer depends on.

        A pair may be asked about more than once: with a prior that was grown, or has learnt from frames in between.
        """
        digest = hashlib.blake2b(digest_size=12)
        asked = (self.registrar, sorted(self.versions.items()), rng.bit_generator.state, density.evidence)
        digest.update(" ".join(map(str, asked)).encode())
        for view in views:
            frame = view.frame
            digest.update(f"{frame.camera!r} {view.plane!r} {view.sigma_wh!r} {view.sigma_r_m!r}".encode())
            for pixels in (frame.depth_m, frame.mask, frame.colour, view.points_m):
                digest.update(b"none" if pixels is None else np.ascontiguousarray(pixels).tobytes())
        drawn = density.sample(_DRAWN, np.random.default_rng(0))
        for numbers in (drawn, density.log_density(drawn), density.log_evidence(drawn)):
            digest.update(np.ascontiguousarray(numbers).tobytes())
        return digest.hexdigest()
