"""Registrations of a run, each stored as soon as it is made."""

from __future__ import annotations

import contextlib
import hashlib
import io
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from modeler.export.files import settle_soon, write_atomically
from modeler.system.regular_files import read_regular
from modeler.types import (
    AbstractPairCache,
    AbstractPoseDensity,
    AbstractRegistrar,
    InputError,
    Mode,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    ViewPair,
)

_CHECK_BYTES = 16  # with which damage goes unnoticed once in 2¹²⁸
_GAUSSIAN = ("mean", "covariance", "by_focal")  # its arrays
_digests: WeakKeyDictionary[RayImage, bytes] = WeakKeyDictionary()  # of views, each part of several keys


@dataclass(frozen=True)
class Pairs:
    """A folder with one file per registration, so that a killed run need not repeat them.

    A file is named by the two frames and two digests: of the views and the method, and of the prior of the motion.
    Registrations of a complete run lie in a second folder; where frames are added, they count as well for pairs whose
    prior has changed by what the new frames tell.
    """

    folder: Path
    """It is made when there is something to keep."""

    def get(self, source: int, target: int, key: tuple[str, str]) -> Posterior | None:
        """Return the stored result, to the bit, or that of a complete run under another prior; None without any."""
        for path in (self._path(source, target, key), self._done / self._name(source, target, key)):
            if (found := _read(path)) is not None:
                return found
        before = sorted(self._done.glob(self._name(source, target, (key[0], "*"))))  # lists all pairs: only if need be
        return next((found for path in before if (found := _read(path)) is not None), None)

    def keep(self, posterior: Posterior, key: tuple[str, str]) -> None:
        """Store the result. If this fails, as on a full disk, it will be computed again."""
        packed = io.BytesIO()
        np.savez(packed, allow_pickle=False, **_arrays(posterior))
        with contextlib.suppress(OSError, InputError):
            self.folder.mkdir(exist_ok=True)
            path = self._path(posterior.source, posterior.target, key)
            data = _check(packed.getvalue()) + packed.getvalue()
            write_atomically(path, data, tidy=False)  # thousands; they go together
            settle_soon(path, self.folder)  # waiting for the disk would take as long as registering

    @property
    def marked(self) -> bool:
        """Whether the folder exists: the sign of an unfinished run."""
        return self.folder.is_dir() and not self.folder.is_symlink()

    def mark(self) -> None:
        """Make the folder.

        Raises:
            OSError: if that cannot be.
        """
        for folder in (self.folder, self._done):
            if folder.is_symlink():
                folder.unlink()
        self.folder.mkdir(exist_ok=True)

    def empty(self) -> None:
        """Forget everything; the folder stays.

        Raises:
            OSError: if that cannot be.
        """
        shutil.rmtree(self._done, ignore_errors=True)
        for file in self.folder.iterdir():
            file.unlink()

    def complete(self) -> None:
        """Move everything to what is of complete runs; the folder goes.

        Raises:
            OSError: if that cannot be.
        """
        if self.marked:
            for file in self.folder.iterdir():
                self._done.mkdir(exist_ok=True)
                file.rename(self._done / file.name)
            self.folder.rmdir()

    @property
    def _done(self) -> Path:
        return self.folder.with_name(f"{self.folder.name}.done")

    def _path(self, source: int, target: int, key: tuple[str, str]) -> Path:
        return self.folder / self._name(source, target, key)

    @staticmethod
    def _name(source: int, target: int, key: tuple[str, str]) -> str:
        return f"{source:06d}-{target:06d}-{key[0]}-{key[1]}.pair"


@dataclass(frozen=True, eq=False)
class PairCache(AbstractPairCache):
    """Returns stored registrations and stores others at once."""

    pairs: Pairs
    """Where they are stored."""
    versions: Mapping[str, str]
    """Of the packages, with others of which results may be others."""

    def posterior_of(self, registrar: AbstractRegistrar, pair: ViewPair) -> Posterior:
        near = None if pair.near is None else pair.near.tobytes().hex()
        inputs = (registrar, sorted(self.versions.items()), pair.rng.bit_generator.state, pair.effort, near)
        key = _of_views(inputs, (pair.source, pair.target)), _of_prior(pair.density)
        stored = self.pairs.get(pair.source.index, pair.target.index, key)
        if stored is not None:
            return stored
        found = registrar.posterior_of(pair)
        self.pairs.keep(found, key)
        return found


def _read(path: Path) -> Posterior | None:
    """Return the registration in a file; None if there is none."""
    try:
        data = read_regular(path)
        packed = data[_CHECK_BYTES:]
        if data[:_CHECK_BYTES] != _check(packed):  # damaged: reading it could fail in any way, or return anything
            return None
        with np.load(io.BytesIO(packed), allow_pickle=False) as kept:
            return _posterior({name: kept[name] for name in kept.files})
    except (InputError, ValueError, KeyError):  # of another version
        return None


def _check(packed: bytes) -> bytes:
    """Return what stands before the arrays in a file, to tell whether they are as they were written."""
    return hashlib.blake2b(packed, digest_size=_CHECK_BYTES).digest()


def _of_views(inputs: Sequence[object], views: Sequence[RayImage]) -> str:
    """Return a digest of all inputs of a registration but the prior."""
    digest = hashlib.blake2b(" ".join(map(str, inputs)).encode(), digest_size=12)
    for view in views:
        if view not in _digests:
            _digests[view] = _digest(view)
        digest.update(_digests[view])
    return digest.hexdigest()


def _of_prior(density: AbstractPoseDensity) -> str:
    """Return a digest of a prior.

    A pair may be registered more than once: with wider limits, or with what was learned from frames in between.
    """
    digest = hashlib.blake2b(str(density.evidence).encode(), digest_size=12)
    drawn = density.sample(64, np.random.default_rng(0))
    for numbers in (drawn, density.log_density(drawn), density.log_prior(drawn)):
        digest.update(np.ascontiguousarray(numbers).tobytes())
    return digest.hexdigest()


def _digest(view: RayImage) -> bytes:
    frame, digest = view.frame, hashlib.blake2b()
    digest.update(
        f"{frame.camera!r} {view.plane!r} {view.sigma_wh!r} {view.sigma_r_m!r} {view.sigma_colour_px!r}".encode()
    )
    for pixels in (frame.depth_m, frame.mask, frame.colour, frame.occluder, view.points_m):
        digest.update(b"none" if pixels is None else np.ascontiguousarray(pixels).tobytes())
    return digest.digest()


def _arrays(posterior: Posterior) -> dict[str, np.ndarray]:
    """Return every field of a posterior as arrays."""
    arrays: dict[str, np.ndarray] = {}
    for field in fields(posterior):
        value, name = getattr(posterior, field.name), field.name
        match value:
            case None:
                arrays[f"{name}.none"] = np.zeros(0)
            case PoseGaussian():
                arrays |= {f"{name}.{part}": getattr(value, part) for part in _GAUSSIAN}
            case Outcome():
                arrays[f"{name}.label"] = np.array(value.label)
            case tuple():  # modes
                arrays[f"{name}.weights"] = np.array([mode.weight for mode in value])
                for part in _GAUSSIAN:
                    arrays[f"{name}.{part}s"] = np.array([getattr(mode.pose, part) for mode in value])
            case _:
                arrays[name] = np.asarray(value)
    return arrays


def _posterior(arrays: dict[str, np.ndarray]) -> Posterior:
    """Return the posterior that arrays hold."""
    values: dict[str, Any] = {}
    for field in fields(Posterior):
        name = field.name
        if f"{name}.none" in arrays:
            values[name] = None
        elif f"{name}.mean" in arrays:
            values[name] = PoseGaussian(*(arrays[f"{name}.{part}"] for part in _GAUSSIAN))
        elif f"{name}.label" in arrays:
            values[name] = Outcome(str(arrays[f"{name}.label"]))
        elif f"{name}.weights" in arrays:
            parts = (arrays[f"{name}.{part}s"] for part in ("weight", *_GAUSSIAN))
            values[name] = tuple(Mode(float(weight), PoseGaussian(*pose)) for weight, *pose in zip(*parts, strict=True))
        else:
            values[name] = arrays[name] if arrays[name].ndim else arrays[name].item()
    return Posterior(**values)
