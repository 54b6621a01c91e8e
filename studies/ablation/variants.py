"""The variants of the study: the default registration without one stage, or with one group of constants scaled."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, final
from unittest import mock

import numpy as np

from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility import directed, ridge
from modeler.registration.visibility.directed import FixedPattern
from modeler.registration.visibility.likelihood import PairLikelihood, VisibilityLikelihood
from modeler.types import Array, RayImage

Kind = Literal["default", "removed", "halved", "doubled"]
Patch = Callable[[], AbstractContextManager[Any]]

_DEFAULT: Final = VisibilityRegistrar()
_NEVER: Final = 1_000_000
_SEEDS: Final = 3


@final
@dataclass(frozen=True)
class Variant:
    """One registration that differs from the default in one thing."""

    name: str
    kind: Kind
    method: VisibilityRegistrar = _DEFAULT
    patched: Patch = nullcontext
    """What is replaced in modules while it runs."""
    seed: int = 0


@dataclass(frozen=True)
class _Other(VisibilityLikelihood):
    """With another likelihood of pairs."""

    change: Callable[[PairLikelihood], PairLikelihood] = lambda pair: pair

    def between(self, source: RayImage, target: RayImage, rng: np.random.Generator) -> PairLikelihood:
        return self.change(super().between(source, target, rng))


class _StatedMisfit(PairLikelihood):
    """With the misfit of a typical match implied by the nominal noise: half a nat."""

    def typical_misfit(self, pose: Array, blur_m: float) -> float:
        return 0.5


class _StatedNoise(PairLikelihood):
    """With the finest blur for the noise of matching surfaces."""

    def noises_m(self, pose: Array, blur_m: float) -> tuple[float, float]:
        return blur_m, super().noises_m(pose, blur_m)[1]


class _NoRims(PairLikelihood):
    """Without errors near silhouettes."""

    def with_rim_m(self, rim_m: float) -> PairLikelihood:
        return self


def _without_pattern(pair: PairLikelihood) -> PairLikelihood:
    """Return a pair whose views have no errors in common."""
    forward, backward = (replace(side, pattern=FixedPattern()) for side in (pair.forward, pair.backward))
    return replace(pair, forward=forward, backward=backward)


class _NoPatches(PairLikelihood):
    """With as many independent measurements on small objects as on large ones."""

    @property
    def temper(self) -> float:
        return self.forward.model.max_independent / self.points


def _of(kind: type[PairLikelihood]) -> VisibilityRegistrar:
    return replace(_DEFAULT, likelihood=_Other(change=lambda pair: kind(pair.forward, pair.backward, pair.size_m)))


def _module(module: object, **values: Any) -> Patch:
    return lambda: mock.patch.multiple(module, **values)


def _changed(component: Any, constants: Mapping[str, object]) -> Any:
    """Return a component with other values of constants, named by their path: `search.basin`."""
    for path, value in constants.items():
        name, _, rest = path.partition(".")
        component = replace(component, **{name: _changed(getattr(component, name), {rest: value}) if rest else value})
    return component


def _with(**constants: object) -> VisibilityRegistrar:
    return _changed(_DEFAULT, {path.replace("__", "."): value for path, value in constants.items()})


def _scaled(factor: float, *paths: str) -> VisibilityRegistrar:
    """Return the default with constants times a factor; whole numbers stay whole."""
    constants = {}
    for path in paths:
        value: Any = _DEFAULT
        for name in path.split("."):
            value = getattr(value, name)
        constants[path] = _times(value, factor)
    return _changed(_DEFAULT, constants)


def _times(value: Any, factor: float) -> Any:
    match value:
        case tuple():
            return tuple(_times(one, factor) for one in value)
        case int():
            return max(round(factor * value), 1)
        case _:
            return factor * value


REMOVED: Final = (
    Variant("choice of starts among samples", "removed", _with(search__proposals=1)),
    Variant("refinement", "removed", _with(refiner__min_matches=_NEVER)),
    Variant("estimated misfit μ", "removed", _of(_StatedMisfit)),
    Variant("estimated noise b", "removed", _of(_StatedNoise)),
    Variant("patches (fewer independent points when small)", "removed", _of(_NoPatches)),
    Variant("correction of chance along ridges", "removed", patched=_module(ridge, _MIN_POSES=_NEVER)),
    Variant("errors near silhouettes", "removed", _of(_NoRims)),
    Variant("fixed pattern", "removed", replace(_DEFAULT, likelihood=_Other(change=_without_pattern))),
    Variant("cost of no overlap", "removed", _with(likelihood__no_overlap_cost=0.0)),
    Variant("cost of normals", "removed", _with(likelihood__normal_cost=0.0)),
    Variant("all modes but the best", "removed", _with(max_modes=1)),
)


def _scalings(factor: float) -> Mapping[str, tuple[VisibilityRegistrar, Patch]]:
    """Return registrations with groups of constants times a factor, the most informative first."""
    hidden = 0.25 if factor < 1.0 else 0.75
    silhouette = _module(directed, _SILHOUETTE_NOISE=0.5 * factor)
    cosines = _module(directed, _COSINES=(factor * np.array([0.1, 0.35, 0.35, 0.6])).astype(np.float32))
    plain = {
        "independent points (300)": _scaled(factor, "likelihood.max_independent"),
        "cost of no overlap (50 nats)": _scaled(factor, "likelihood.no_overlap_cost"),
        "scale of overlap (0.1)": _scaled(factor, "likelihood.overlap_scale"),
        "blurs (0.12 to 0.015)": _scaled(factor, "search.finest"),
        "starts (400, 60, 3 a basin)": _scaled(factor, "search.max_starts", "search.min_starts", "search.per_basin"),
        "hidden share η (0.5; 0.25 and 0.75)": _with(likelihood__hidden_share=hidden),
        "cost of one point K (10 nats)": _scaled(factor, "likelihood.max_point_cost"),
        "cost of normals κ (2 nats)": _scaled(factor, "likelihood.normal_cost"),
        "silhouette noise (0.5)": silhouette,
        "surface noise (0.1)": _scaled(factor, "likelihood.surface_noise"),
        "surface detail (0.003)": _scaled(factor, "likelihood.surface_detail"),
        "sampler's sizes (200, 300)": _scaled(factor, "sampler.draws", "sampler.samples"),
        "patches of the refinement (32)": _scaled(factor, "refiner.patches"),
        "points (600)": _scaled(factor, "likelihood.points"),
        "samples for each start (15)": _scaled(factor, "search.proposals"),
        "size of a basin (0.2)": _scaled(factor, "search.basin"),
        "iterations of the descent (4)": _scaled(factor, "search.steps"),
        "modes (4)": _scaled(factor, "max_modes"),
        "sampler: least effective size (100)": _scaled(factor, "sampler.min_effective"),
        "sampler: draws at most (8000)": _scaled(factor, "sampler.max_draws"),
        "refinement: matches of a patch (6)": _scaled(factor, "refiner.min_matches"),
        "cosines of visibility (0.1 to 0.6)": cosines,
    }
    return {
        name: (way, nullcontext) if isinstance(way, VisibilityRegistrar) else (_DEFAULT, way)
        for name, way in plain.items()
        if not (way is cosines and factor > 1.0)  # cosines beyond 1
    }


def _groups() -> list[Variant]:
    tables: dict[Kind, Mapping[str, tuple[VisibilityRegistrar, Patch]]] = {
        "halved": _scalings(0.5),
        "doubled": _scalings(2.0),
    }
    return [
        Variant(name, kind, *table[name])
        for name in tables["halved"]
        for kind, table in tables.items()
        if name in table
    ]


VARIANTS: Final = (
    *(Variant(f"seed {seed}", "default", seed=seed) for seed in range(_SEEDS)),
    *REMOVED,
    *_groups(),
)
"""All of them, the most informative first."""
