"""Registrations of a run that has not ended, each kept as soon as it is made."""

from __future__ import annotations

import contextlib
import hashlib
import io
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from modeler.export.files import settle_soon, write_atomically
from modeler.regular_files import read_regular
from modeler.types import (
    AbstractPoseDensity,
    AbstractRegistrar,
    InputError,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
)

_NUMBERS = ("overlap", "effective_samples", "pareto_k", "log_evidence", "seconds")
_DRAWN = 64  # poses by which one prior is told from another


@final
@dataclass(frozen=True)
class Pairs:
    """A folder with one file a registration, so that a run that was killed need not make them again.

    A file is named by the two frames and by what was asked of them: another question has another answer.
    """

    folder: Path
    """It is made when there is something to keep."""

    def get(self, source: int, target: int, question: str) -> Posterior | None:
        """Return what was found, to the bit; None where it is not there.

        Args:
            source: frame number.
            target: frame number.
            question: a digest of all that the answer depends on.
        """
        try:
            packed = io.BytesIO(read_regular(self._path(source, target, question)))
            with np.load(packed, allow_pickle=False) as kept:
                return _posterior(source, target, {name: kept[name] for name in kept.files})
        except (InputError, OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def keep(self, posterior: Posterior, question: str) -> None:
        """Keep what was found. Where that cannot be, say for want of space, it will have to be found again."""
        packed = io.BytesIO()
        np.savez(packed, allow_pickle=False, **_arrays(posterior))
        with contextlib.suppress(OSError, InputError):
            self.folder.mkdir(exist_ok=True)
            path = self._path(posterior.source, posterior.target, question)
            write_atomically(path, packed.getvalue())
            settle_soon(path, self.folder)  # waiting for the disk would take as long as registering

    def drop(self) -> None:
        """Forget everything, or, where the program is killed at it, nothing.

        Raises:
            OSError: where that cannot be.
        """
        gone = self.folder.with_name(f"{self.folder.name}.dropped")
        shutil.rmtree(gone, ignore_errors=True)
        if self.folder.is_dir() and not self.folder.is_symlink():
            self.folder.rename(gone)
            shutil.rmtree(gone)

    def _path(self, source: int, target: int, question: str) -> Path:
        return self.folder / f"{source:06d}-{target:06d}-{question}.npz"


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


def _arrays(posterior: Posterior) -> dict[str, np.ndarray]:
    """Return a posterior as arrays."""
    return {
        "mean": posterior.pose.mean,
        "covariance": posterior.pose.covariance,
        "outcome": np.array(posterior.outcome.label),
        "samples": posterior.samples,
        "weights": posterior.weights,
        "numbers": np.array([getattr(posterior, name) for name in _NUMBERS]),
        "mode_weights": np.array([mode.weight for mode in posterior.modes]),
        "mode_means": np.array([mode.pose.mean for mode in posterior.modes]),
        "mode_covariances": np.array([mode.pose.covariance for mode in posterior.modes]),
    }


def _posterior(source: int, target: int, arrays: dict[str, np.ndarray]) -> Posterior:
    """Return the posterior that arrays hold."""
    modes = zip(arrays["mode_weights"], arrays["mode_means"], arrays["mode_covariances"], strict=True)
    return Posterior(
        source=source,
        target=target,
        pose=PoseGaussian(arrays["mean"], arrays["covariance"]),
        outcome=Outcome(str(arrays["outcome"])),
        samples=arrays["samples"],
        weights=arrays["weights"],
        modes=tuple(Mode(float(weight), PoseGaussian(mean, covariance)) for weight, mean, covariance in modes),
        **dict(zip(_NUMBERS, arrays["numbers"].tolist(), strict=True)),
    )
