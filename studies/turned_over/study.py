"""One recording from its plan to figures: whether both postures are in one model, and whether that is right."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, final

from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import MethodOptions, ObjectOptions
from modeler.types import Step
from studies.trust.plan import Half
from studies.trust.stage import Recorded
from studies.trust.study import MAX_DEG, MAX_M, f_score, pose_errors
from studies.turned_over.plan import FRAMES, Plan


@final
@dataclass(frozen=True)
class Outcome:
    """What a recording came to."""

    half: Half
    """Of the study."""
    number: int
    """Within the half."""
    shape: str
    """Name of the object's recipe."""
    gap: str
    """What was seen between the postures."""
    prior: str
    """As given."""
    masks: bool
    """Whether there were any."""
    placed: tuple[int, int]
    """Number of frames of each posture that are in the model."""
    status: int
    """With which `modeler build` ends: 0 or 3."""
    reasons: tuple[str, ...]
    """What speaks against the model."""
    error_deg: float | None
    """Largest rotation error of a pose against the first."""
    error_m: float | None
    """Largest error of the object's place."""
    f_score: float | None
    """Of the mesh against what the frames saw, at 5 mm."""
    seconds: float
    """Wall time of the run without rendering."""

    @property
    def right(self) -> bool:
        """Whether no pose is wrong."""
        return self.error_deg is not None and self.error_m is not None and not self.wrong

    @property
    def wrong(self) -> bool:
        """Whether some pose is."""
        return (self.error_deg or 0.0) > MAX_DEG or (self.error_m or 0.0) > MAX_M

    @property
    def joined(self) -> bool:
        """Whether most frames of both postures are in the model."""
        return min(self.placed) > FRAMES // 2

    def values(self) -> dict[str, Any]:
        """Return the figures as JSON holds them."""
        return asdict(self)

    @staticmethod
    def of(values: dict[str, Any]) -> Outcome:
        """Return what JSON held."""
        said = {field.name: values[field.name] for field in fields(Outcome)}
        return Outcome(**{**said, "placed": tuple(said["placed"]), "reasons": tuple(said["reasons"])})


def outcome(plan: Plan, folder: Path) -> Outcome:
    """Build the model of a plan as `modeler build` does, without recording, and compare it with the truth.

    Args:
        plan: of the recording.
        folder: where its mesh is written.
    """
    recorded = Recorded(plan.stage())
    options = recorded.stage.options
    len(recorded.indices)  # rendered before the clock starts
    began = time.perf_counter()
    modeler = compose.modeler(recorded, options, MethodOptions(seed=plan.seed % 1000), ObjectOptions())
    closes = comes_back(recorded, modeler.prior, modeler.closer.max_angle_deg)
    *_, last = modeler.run(recorded, compose.scene(modeler, recorded), closure_expected=closes)
    assert isinstance(last, Step)
    assert last.verdict is not None
    seconds = time.perf_counter() - began
    trajectory = last.solution.trajectory
    error_deg, error_m = pose_errors(recorded, last)
    return Outcome(
        half=plan.half,
        number=plan.number,
        shape=plan.shape,
        gap=plan.gap,
        prior=str(options.prior),
        masks=recorded.stage.masks,
        placed=(
            sum(frame < FRAMES for frame in trajectory),
            sum(frame > max(plan.gap_frames, default=FRAMES - 1) for frame in trajectory),
        ),
        status=0 if last.verdict.trustworthy else 3,
        reasons=last.verdict.reasons,
        error_deg=error_deg,
        error_m=error_m,
        f_score=None if last.model is None else f_score(recorded, last.model, trajectory),
        seconds=seconds,
    )


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a line a recording, and counts."""
    lines = [f"{'':20}{'gap':9}{'prior':11}{'masks':7}{'frames':>9}{'error':>16}{'F':>7}{'status':>8}{'s':>6}"]
    for one in outcomes:
        error = (
            "-" if one.error_deg is None or one.error_m is None else f"{one.error_deg:.1f}° {1e3 * one.error_m:.1f} mm"
        )
        score = "-" if one.f_score is None else f"{one.f_score:.3f}"
        placed = f"{one.placed[0]}+{one.placed[1]}"
        lines.append(
            f"{one.shape:20}{one.gap:9}{one.prior:11}{'yes' if one.masks else 'no':7}{placed:>9}{error:>16}{score:>7}"
            f"{one.status:8}{one.seconds:6.0f}"
        )
    right = sum(one.joined and one.right for one in outcomes)
    zero = sum(one.joined and one.right and one.status == 0 for one in outcomes)
    wrong = sum(one.wrong for one in outcomes)
    lying = sum(one.wrong and one.status == 0 for one in outcomes)
    lines.append(
        f"{len(outcomes)} recordings: {right} joined right, {zero} of them with status 0; {wrong} wrong, {lying} of "
        "them with status 0"
    )
    return "\n".join(lines)
