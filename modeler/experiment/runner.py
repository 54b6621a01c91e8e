"""An experiment from sequences to files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from modeler.experiment.experiment import Experiment
from modeler.experiment.recorded import Recorded
from modeler.experiment.results import results_csv, results_json
from modeler.experiment.summaries import Summary, summaries
from modeler.experiment.trials import Trial
from modeler.export import write_atomically
from modeler.types import InputError


def evaluate(
    sequences: Sequence[Recorded],
    experiment: Experiment,
    out: Path,
    *,
    draw: Callable[[Sequence[Trial]], bytes],
    told: Callable[[Trial], None],
) -> list[Summary]:
    """Run an experiment and write `results.json`, `results.csv` and `rotation_errors.png` into a folder.

    Args:
        sequences: with ground truth, or such as are a closed turn where that is the pairing.
        experiment: what to do with each.
        out: folder, made where there is none; the three files of an earlier experiment are replaced at the end.
        draw: makes a PNG of the trials.
        told: hears of every trial as soon as it is done; there are `experiment.size(sequence)` for each sequence.

    Raises:
        InputError: where a sequence has nothing to be judged by or cannot be read, or `out` cannot be written.
    """
    names = [recorded.name for recorded in sequences]
    for recorded in sequences:
        if names.count(recorded.name) > 1:
            raise InputError(f"two sequences are called {recorded.name!r}; give each a name in its sequence.json.")
        experiment.size(recorded)  # refuses what cannot be judged, before hours are spent on the others
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); choose another folder with --out") from error
    trials: list[Trial] = []
    for recorded in sequences:
        for trial in experiment.trials(recorded):
            trials.append(trial)
            told(trial)
    rows = summaries(trials, experiment.success_deg, loops=experiment.pairing.loops)
    write_atomically(out / "results.json", results_json(experiment, trials, rows))
    write_atomically(out / "results.csv", results_csv(trials))
    write_atomically(out / "rotation_errors.png", draw(trials))
    return rows
