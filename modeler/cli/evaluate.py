"""`modeler register` and `evaluate`: one pair, and methods and models against ground truth."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from modeler.cli.console import as_options, bar, say
from modeler.cli.options import FrameOptions, StrictPaths
from modeler.composition.options import OF_EXTRAS, SEED, Method, MethodOptions, ObjectOptions, PriorOptions, default
from modeler.runs.compiling import compile_kernels

if TYPE_CHECKING:
    from modeler.experiment import ModelScore, Pairing, Summary
    from modeler.runs.reopening import Part
    from modeler.sequences import AbstractSequence
    from modeler.sequences.meshes import Mesh
    from modeler.types import AbstractRegistrar, Array


@dataclass(frozen=True)
class Evaluate:
    """Register pairs of frames with known true motion by several methods, and report their errors.

    Writes results.json, results.csv and rotation_errors.png (box plots), and prints a table: errors of rotation in
    degrees and of position in mm (median, 90 % quantile, largest), the median NEES (5.3 if calibrated), the rotation
    that is left after a closed turn and the sum of its steps, and seconds a pair. For run folders, it compares the
    model with the true surface instead (model.ply of a rendered sequence, BOP's models folder), and also a model of the
    same frames with their true poses: models.json, models.csv and a table, in which max deg is the largest rotation
    error of a pose after all are aligned to the truth together. Runs without ground truth are left out, and the status
    is 2.
    """

    sequences: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SEQUENCE|RUN...", help_behavior_hint="(at least one)"),
    ]
    """Sequences with ground truth (scene_gt.json; none is needed with --closed), or their run folders."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results."""
    overwrite: bool = False
    """Replace the results of an earlier evaluation in the folder."""
    methods: Annotated[str, tyro.conf.arg(metavar="NAME,...")] = ",".join(
        name for name in get_args(Method) if name not in OF_EXTRAS
    )
    """Methods to compare; kiss needs the extra peers and runs only if named."""
    offsets: Annotated[str, tyro.conf.arg(metavar="N,...")] = "1"
    """Differences of frame numbers to compare; each gives a table of its own."""
    both_ways: bool = False
    """Register each pair in both directions, not only the later frame to the earlier."""
    closed: bool = False
    """Treat the sequence as a full turn: its last frame is followed by its first.
    The remaining rotation of all composed steps, and the sum of their angles, are printed too, without ground truth."""
    learn: bool = False
    """Let the prior learn from earlier pairs, as in `build`: the unknown axis and sign of a turntable."""
    points: Annotated[int | None, tyro.conf.arg(metavar="N"), default("all")] = None
    """Keep N of the object's surface points per view, drawn at random, to simulate sparse clouds."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same errors."""
    strict_paths: StrictPaths = False
    prior: PriorOptions = field(default_factory=PriorOptions)
    selection: FrameOptions = field(default_factory=FrameOptions)
    where: ObjectOptions = field(default_factory=ObjectOptions)

    def run(self) -> int:
        """Run the experiment, write its results and print a table.

        Runs that cannot be evaluated are left out, each with a line on stderr, and the status is 2.
        """
        from modeler.runs.outputs import check_files, run_inputs
        from modeler.types import InputError

        if not self.sequences:
            raise InputError("no sequence to evaluate; name at least one folder")
        if self.points is not None and self.points < 1:
            raise InputError(f"--points {self.points} is out of range; give a whole number from 1")
        runs = [path for path in self.sequences if (path / "report.json").is_file()]
        if not runs:
            names = ("results.json", "results.csv", "rotation_errors.png")
            check_files([self.out / name for name in names], self.sequences, overwrite=self.overwrite)
            return _evaluate_pairs(self)
        if len(runs) < len(self.sequences):
            lacking = next((path for path in self.sequences if not path.exists()), None)
            if lacking is not None:
                raise InputError(f"{lacking}: no such folder; give folders of runs")
            raise InputError("sequences and run folders are evaluated separately; give one kind at a time")
        outs = [self.out / name for name in ("models.json", "models.csv")]
        check_files(outs, run_inputs(runs), overwrite=self.overwrite)
        return _evaluate_models(runs, self.out, self.seed)


def _evaluate_pairs(options: Evaluate) -> int:
    """Register pairs of frames by each method, write their errors, print a table and return the exit status."""
    from modeler import experiment
    from modeler.composition import compose
    from modeler.experiment import Experiment, Pairing
    from modeler.sequences import Overrides, frame_range, open_sequence
    from modeler.viz import figures

    kept, overrides = frame_range(options.selection.frames), Overrides(strict_paths=options.strict_paths)
    recorded = [open_sequence(path, overrides).select(options.selection.every, kept) for path in options.sequences]
    for sequence in recorded:
        compose.check_region(options.where, sequence)
    # Tables are compared with each other: all sequences have the same prior, `general` if none is asked for.
    prior = replace(options.prior, prior=options.prior.prior or "general")
    plan = Experiment(
        methods=_methods(options.methods),
        prior=compose.chosen_prior(prior, recorded[0] if len(recorded) == 1 else None),
        pairing=Pairing(_offsets(options.offsets), both_ways=options.both_ways, closed=options.closed),
        segmenter=compose.segmenter(options.where),
        points=options.points,
        learn=options.learn,
        seed=options.seed,
    )
    _check_offsets(plan.pairing, recorded)
    compile_kernels(say)
    with bar() as progress:
        task = progress.add_task("", total=sum(plan.size(sequence) for sequence in recorded))
        rows = experiment.evaluate(
            recorded,
            plan,
            options.out,
            draw=figures.rotation_errors,
            report=lambda trial: progress.update(task, advance=1, description=f"{trial.sequence}, {trial.method}"),
        )
    print(table(rows))
    return 0


def table(rows: Sequence[Summary]) -> str:
    """Return summaries as text in columns; unknown values are left out."""
    measured = tuple(f"{what} {share}" for what in ("deg", "mm") for share in ("50 %", "90 %", "max"))
    heading = ("sequence", "method", "apart", "pairs", "usable", "right", *measured)
    cells = [
        (
            row.sequence,
            row.method,
            str(row.offset),
            str(row.pairs),
            str(row.usable),
            "" if row.successes is None else str(row.successes),
            *(
                _number(value, 2)
                for errors in (row.rotation_error_deg, row.translation_error_mm)
                for value in (errors.median, errors.ninth_decile, errors.largest)
            ),
            _number(row.median_nees, 1),
            _number(row.loop_deg, 2),
            _number(row.turned_deg, 0),
            _number(row.seconds, 2),
        )
        for row in rows
    ]
    lines = [(*heading, "NEES", "loop deg", "of", "s"), *cells]
    filled = [number for number, column in enumerate(zip(*lines, strict=True)) if any(column[1:])]
    return columns([tuple(line[number] for number in filled) for line in lines], left=2)


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def columns(lines: Sequence[tuple[str, ...]], *, left: int) -> str:
    """Return lines of cells as text in columns, the first `left` of them flush left, the others right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            f"{cell:<{width}}" if number < left else f"{cell:>{width}}" for number, (cell, width) in enumerate(pairs)
        )
        for pairs in (list(zip(line, widths, strict=True)) for line in lines)
    )


def _methods(names: str) -> dict[str, AbstractRegistrar]:
    """Return registrars by name from a list with commas."""
    from modeler.composition import compose
    from modeler.types import InputError

    known: dict[str, Method] = {name: name for name in get_args(Method)}
    chosen = [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in known:
            raise InputError(f"--methods {names}: there is no method {name!r}; there are {', '.join(known)}")
    return {name: compose.registrar(known[name]) for name in chosen}


def _check_offsets(pairing: Pairing, recorded: Sequence[AbstractSequence]) -> None:
    """Refuse frames so far apart that no sequence has two of them."""
    from modeler.types import InputError

    for offset in pairing.offsets:
        alone = replace(pairing, offsets=(offset,))
        if not any(True for sequence in recorded for _ in alone.pairs(sequence.indices)):
            most = max(map(len, recorded))
            raise InputError(f"--offsets {offset}: no pair of frames is so far apart in {most} frames; give less")


def _offsets(text: str) -> tuple[int, ...]:
    """Return whole numbers from a list with commas."""
    from modeler.types import InputError

    offsets = text.split(",")
    if not all(offset.strip().isdecimal() and int(offset) > 0 for offset in offsets):
        raise InputError(f"--offsets {text} is no list of whole numbers from 1 on; write for instance 1,2,3")
    return tuple(dict.fromkeys(int(offset) for offset in offsets))


def _evaluate_models(runs: Sequence[Path], out: Path, seed: int) -> int:
    """Evaluate the models of runs, write `models.json` and `models.csv`, print a table and return the exit status."""
    from modeler.experiment import write_models
    from modeler.types import InputError

    scores, left_out = [], []
    for path in runs:
        try:
            scores += _scores(path, seed)
        except InputError as error:
            if len(runs) == 1:
                raise
            left_out.append(f"{path} is left out: {str(error).removesuffix('.')}")
    if not scores:
        raise InputError(left_out[0])
    write_models(scores, out, seed)
    print(columns(_models_table(scores), left=3))
    for line in left_out:
        say(line)
    return 2 if left_out else 0


def _scores(path: Path, seed: int) -> list[ModelScore]:
    """Judge the model of a run by the true surface and the true poses."""
    from modeler.experiment import Modelled, model_scores
    from modeler.export import mesh_of, read_model
    from modeler.fusion import Fuser
    from modeler.runs.reopening import reopened

    run = reopened(path)
    truth, mesh = _truth(path, run.parts)
    modelled = Modelled(
        name=str(path),
        model=read_model(mesh_of(path)),
        views=run.views,
        trajectory=run.solution.trajectory,
        camera_from_model=truth,
        truth=(mesh.vertices_m, mesh.triangles),
    )
    return model_scores(modelled, Fuser(voxel_m=run.report["settings"].get("voxel_m")), seed)


def _truth(run: Path, parts: Sequence[Part]) -> tuple[dict[int, Array], Mesh]:
    """Return the true camera_from_model (4, 4) by frame number, and the true surface."""
    from modeler.sequences import true_mesh
    from modeler.types import InputError

    poses: dict[int, Array] = {}
    meshes: list[Mesh] = []
    for part in parts:
        truth = part.truth()
        if truth is None:
            raise InputError(f"{part.sequence.name}: has no ground truth to compare with; add scene_gt.json.")
        poses |= truth
        meshes.append(true_mesh(part.sequence))
    first = meshes[0].vertices_m
    for part, mesh in zip(parts, meshes, strict=True):
        if mesh.vertices_m.shape != first.shape or abs(mesh.vertices_m - first).max() > 1e-5:  # m
            raise InputError(
                f"{run}: {parts[0].sequence.name} and {part.sequence.name}, of which it is joined, have different true "
                "surfaces; evaluate the runs it joins"
            )
    return poses, meshes[0]


def _models_table(scores: Sequence[ModelScore]) -> list[tuple[str, ...]]:
    """Return heading and rows of a table of scores."""
    heading = ("model", "poses", "over", "frames", "max deg", "accuracy mm", "completeness mm", "F 3 mm", "F 5 mm")
    lines: list[tuple[str, ...]] = [heading]
    for score in scores:
        lengths = (f"{value:.2f}" for value in (score.rotation_error_deg, score.accuracy_mm, score.completeness_mm))
        shares = f"{score.f_3mm:.3f}", f"{score.f_5mm:.3f}"
        lines.append((score.run, score.poses, score.over, str(score.frames), *lengths, *shares))
    return lines


@dataclass(frozen=True)
class Register:
    """Register two frames of a sequence and print target_from_source as a JSON edge.

    The edge has the fields of an edge in report.json except `seconds`, which goes to stderr: same seed, same bytes.
    """

    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SEQUENCE")]
    """A sequence in any format that `modeler build` takes."""
    source: Annotated[tyro.conf.Positional[int], tyro.conf.arg(metavar="SOURCE")]
    """Number of the source frame, whose points are transformed."""
    target: Annotated[tyro.conf.Positional[int], tyro.conf.arg(metavar="TARGET")]
    """Number of the target frame, to whose camera coordinates they are transformed."""
    strict_paths: StrictPaths = False
    prior: PriorOptions = field(default_factory=PriorOptions)
    method: MethodOptions = field(default_factory=MethodOptions)
    where: ObjectOptions = field(default_factory=ObjectOptions)

    def run(self) -> int:
        """Register the pair; status 3 if the result would not become an edge."""
        from modeler.composition import compose
        from modeler.export import edge_record
        from modeler.sequences import Overrides, open_sequence
        from modeler.types import Edge, InputError, Solution, Stated
        from modeler.verdict.advice import outcome_advice

        if self.source == self.target:
            raise InputError(f"SOURCE and TARGET are both frame {self.source}; name two frames")
        sequence = open_sequence(self.sequence, Overrides(strict_paths=self.strict_paths))
        modeler = compose.modeler(sequence, self.prior, self.method, self.where)
        compile_kernels(say)
        scene = compose.scene(modeler, sequence)
        views = []
        for index in (self.source, self.target):
            prepared = modeler.prepare(sequence.frame(index), scene)
            if prepared.view is None:
                failure = prepared.failure
                raise InputError(f"{self.sequence}: frame {index} has {failure.label}. {outcome_advice(failure)}")
            views.append(prepared.view)
        posterior = modeler.register(*views)
        what_to_do = outcome_advice(posterior.outcome, modeler.prior, posterior)
        edge = Edge(posterior, "odometry", posterior.usable, Stated(as_options(what_to_do)))
        record = edge_record(edge, Solution(), sigma_focal=modeler.sensor.noise.sigma_focal)
        del record["seconds"]  # the same pair has the same record
        print(json.dumps(record, allow_nan=False))
        _, remark = compose.resolved_prior(self.prior, sequence)
        summary = [f"{posterior.outcome.label} after {posterior.seconds:.2f} s", *([remark] if remark else [])]
        say("; ".join(summary))
        return 0 if posterior.usable else 3
