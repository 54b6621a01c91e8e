"""`modeler register`: one pair."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import as_options, say
from modeler.cli.options import StrictPaths
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.runs.compiling import compile_kernels


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
