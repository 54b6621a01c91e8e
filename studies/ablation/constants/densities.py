"""The stage of priors: densities of all kinds between the same two views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modeler import se3
from modeler.priors import (
    AnyMotion,
    AutoPrior,
    FeaturesPrior,
    GeneralPrior,
    HeldPrior,
    Poke,
    PokePrior,
    ProductPrior,
    TablePrior,
    TurntablePrior,
    VelocityPrior,
)
from modeler.types import AbstractPrior, HandPoses, Solution
from studies.ablation.constants.inputs import Figures, Posed, digest


def densities(pair: Posed) -> Figures:
    """Evaluate and sample the densities of all priors between the second view and the third, of known motion."""
    frames = sorted(pair.trajectory)
    source, target = pair.views[frames[2]], pair.views[frames[1]]
    truth = se3.inverse(pair.trajectory[frames[1]]) @ pair.trajectory[frames[2]]
    figures: Figures = {}
    whole = []
    for name, prior in _priors(pair, frames).items():
        density = prior.between(source, target)
        drawn = density.sample(64, np.random.default_rng(0))
        figures[name] = float(density.log_density(truth[None])[0])
        whole.append((name, figures[name], drawn, density.log_density(drawn)))
    return {"digest": digest(whole).hex()[:12], **figures}


def _priors(pair: Posed, frames: Sequence[int]) -> dict[str, AbstractPrior]:
    """Return priors of all kinds that hold for the motion of a rendered box on its table."""
    known = Solution({frame: pair.trajectory[frame] for frame in frames[:2]})
    centre_m = pair.views[frames[1]].centroid_m
    hand = [se3.inverse(pair.trajectory[frame]) for frame in frames[:4]]
    held = HeldPrior(HandPoses(np.arange(4.0), np.array(hand)))
    up = (0.0, -1.0, 0.0)
    poke = PokePrior(Poke((float(centre_m[0]) + 0.03, float(centre_m[1]), float(centre_m[2])), (0.0, 0.5, 0.9), 0.03))
    turned = TurntablePrior(25.0, axis_direction=up)
    motions: dict[str, AbstractPrior] = {
        "auto": AutoPrior(),
        "general": GeneralPrior(),
        "any": AnyMotion(),
        "relaxed": AutoPrior().relaxed(3.0),
        "table": TablePrior(),
        "held": held,
        "poke": poke,
        "turntable": turned,
        "turntable, axis unknown": replace(turned, axis_direction=None, step_sign="unknown"),
        "turntable, earlier": replace(turned, previous=frames[3]),
        "velocity": VelocityPrior().learned(known, ()),
        "features": FeaturesPrior(),
        "held and table": ProductPrior(held, TablePrior()),
    }
    return motions
