"""Register views one to four steps apart without initial guess, and count right and usable results.

    python -m studies far_apart                                  # tuning shapes and recordings, three minutes
    python -m studies far_apart --half held-out --limits none    # a single evaluation, at the end

The given limits contain the motion, are wide (180° and 20 cm), or are the defaults. A result is right if its rotation
error is below 5° (16.2° for the dragon and the dog, as in the literature). Baselines are FPFH with RANSAC, and
KISS-Matcher if installed, both followed by ICP. A wrong result is missed if the images fit the truth better by 3 nats;
otherwise the evidence is at fault. The status is 1 if no pair is right: then the study is broken.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, final, get_args

import numpy as np

from modeler.baselines import FpfhIcpRegistrar, KissIcpRegistrar
from modeler.evaluation import rotation_error_deg
from modeler.pipeline import Modeler
from modeler.priors import AutoPrior
from modeler.registration import VisibilityLikelihood, VisibilityRegistrar
from modeler.types import AbstractRegistrar, Posterior
from studies.far_apart.pairs import Limits, Pair, pairs

_MISSED_NATS: Final = 3.0


@final
@dataclass(frozen=True)
class Trial:
    """One pair, registered."""

    method: str
    """A peer, or `visibility` and what is said of the motion."""
    group: str
    name: str
    steps: int
    error_deg: float
    right: bool
    usable: bool
    missed: bool
    """Whether the answer is wrong and the images better explained by the truth."""
    seconds: float
    """Of a processor."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(
        prog="python -m studies far_apart", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="which shapes")
    parser.add_argument("--limits", nargs="+", choices=get_args(Limits), default=get_args(Limits), help="given limits")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th target of recordings")
    parser.add_argument("--no-colour", action="store_true", help="by depth alone")
    parser.add_argument("--seed", type=int, default=0, help="of the registration")
    options = parser.parse_args(arguments)
    trials = []
    for number, pair in enumerate(pairs(options.half, every=options.every)):
        trials += _trials(pair, options.limits, (options.seed, number), colour=not options.no_colour)
        print(f"{number + 1}: {pair.name}, {pair.turn_deg:.0f}°", file=sys.stderr, flush=True)
    print(text(trials))
    return 0 if any(trial.right for trial in trials) else 1


def _trials(pair: Pair, limits: Iterable[Limits], seed: tuple[int, int], *, colour: bool) -> Iterator[Trial]:
    """Yield what is made of a pair."""
    ours = VisibilityRegistrar(VisibilityLikelihood(colour=colour))

    def by(registrar: AbstractRegistrar, limit: Limits) -> Posterior:
        return registrar.register(pair.source, pair.target, pair.density(limit), rng=np.random.default_rng(seed))

    without_limits = Modeler(registrar=ours, prior=AutoPrior(), seed=seed[0])  # as `modeler register` does
    methods = {f"visibility, {given}": partial(by, ours, given) for given in limits if given != "default"}
    if "default" in limits:
        methods["visibility, default"] = partial(without_limits.register, pair.source, pair.target)
    methods["fpfh-icp"] = partial(by, FpfhIcpRegistrar(), "none")
    if importlib.util.find_spec("kiss_matcher") is not None:
        methods["kiss"] = partial(by, KissIcpRegistrar(), "none")
    for method, register in methods.items():
        began_s = time.process_time()
        posterior = register()
        seconds = time.process_time() - began_s
        compared = ours.likelihood.between(pair.source, pair.target, np.random.default_rng(seed))
        poses = np.stack([pair.truth, posterior.pose.mean])
        at_truth, at_answer = compared.tempered(poses, ours.search.fine_m(compared))
        error_deg = rotation_error_deg(posterior.pose.mean, pair.truth)
        right = error_deg < pair.right_deg
        missed = not right and bool(at_truth > at_answer + _MISSED_NATS)
        yield Trial(method, pair.group, pair.name, pair.steps, error_deg, right, posterior.usable, missed, seconds)


def text(trials: Sequence[Trial]) -> str:
    """Return what a person reads."""
    lines = [
        f"{'':<22}{'':<14}{'steps':>6}{'pairs':>7}{'right':>7}{'by (deg)':>10}{'usable':>8}{'of them right':>15}"
        f"{'missed':>8}{'s':>7}"
    ]
    for method in dict.fromkeys(trial.method for trial in trials):
        mine = [trial for trial in trials if trial.method == method]
        cells = dict.fromkeys((trial.group, trial.steps) for trial in mine)
        for group, steps in cells:
            lines.append(_line(method, group, str(steps), [t for t in mine if (t.group, t.steps) == (group, steps)]))
        lines += [_line(method, "all", "", mine), ""]
    for trial in trials:
        if trial.usable and not trial.right:
            lines.append(f"stood by and wrong: {trial.method}, {trial.name}, {trial.steps}: {trial.error_deg:.0f}°")
    return "\n".join(lines)


def _line(method: str, group: str, steps: str, trials: Sequence[Trial]) -> str:
    usable = [trial for trial in trials if trial.usable]
    share = f"{100 * np.mean([trial.right for trial in usable]):.0f} %" if usable else "-"
    right, missed = (sum(values) for values in zip(*((t.right, t.missed) for t in trials), strict=True))
    seconds = np.median([trial.seconds for trial in trials])
    errors_deg = [trial.error_deg for trial in trials if trial.right]
    error = f"{np.median(errors_deg):.2f}" if errors_deg else "-"
    shares = f"{len(trials):>7}{right:>7}{error:>10}{len(usable):>8}{share:>15}{missed:>8}"
    return f"{method:<22}{group:<14}{steps:>6}{shares}{seconds:>7.2f}"


if __name__ == "__main__":
    sys.exit(main())
