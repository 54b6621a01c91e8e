"""Standard deviations and other readings of each pair and pose: over time, in words, and in a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from modeler import se3
from modeler.export.report import undetermined
from modeler.types import ACCEPTED, Array, Edge, PoseGaussian, Posterior, Step, explain, loop_closure_error
from modeler.viz import entities
from modeler.viz.drawings import Drawing


@dataclass(frozen=True)
class Sd:
    """Standard deviations of a relative pose along its least certain axes."""

    rotation_deg: float
    translation_mm: float
    """Of the object's centre: that of the camera's own origin is mostly the rotation times the object's distance."""


def sd_of(pose: PoseGaussian, centre_m: Array) -> Sd:
    """Return the standard deviations of a relative pose; NaN if its covariance is not finite.

    Args:
        pose: with ξ in the coordinates in which `centre_m` is given.
        centre_m: (3,) the object's centre.
    """
    if not np.isfinite(pose.covariance).all():
        return Sd(math.nan, math.nan)
    covariance = se3.covariance_about(pose.covariance, centre_m)
    turn_rad, shift_m = worst_axis_sds(covariance)
    return Sd(math.degrees(turn_rad), 1000.0 * shift_m)


def certainty_words(posterior: Posterior, centre_m: Array) -> list[str]:
    """Return the readings of a registration in words, without those that its method does not give.

    Args:
        posterior: of target_from_source.
        centre_m: (3,) the object's centre in the source camera's frame.
    """
    sd = sd_of(posterior.pose, centre_m)
    samples = f"{posterior.effective_samples:.0f}"
    readings = (
        (sd.rotation_deg, f"rotation sd {_short(sd.rotation_deg)}°"),
        (sd.translation_mm, f"translation sd {_short(sd.translation_mm)} mm"),
        (posterior.overlap, f"overlap {100.0 * posterior.overlap:.0f} %"),
        (posterior.effective_samples, f"{samples} effective sample" + "s" * (samples != "1")),
        (posterior.seconds, f"{posterior.seconds:.2g} s"),
    )
    return [said for value, said in readings if math.isfinite(value)]


def _short(value: float) -> str:
    """Return a number with two significant digits, at least 0.01."""
    return "<0.01" if 0.0 < value < 0.01 else f"{value:.2g}"


def worst_axis_sds(covariance: Array) -> tuple[float, float]:
    """Return the sd of rotation and translation, each along its least certain axis, of a covariance (6, 6) of ξ."""
    turn, shift = np.linalg.eigvalsh(np.array([covariance[:3, :3], covariance[3:, 3:]]))[:, -1].tolist()
    return math.sqrt(max(turn, 0.0)), math.sqrt(max(shift, 0.0))


_SERIES_RGB = {"odometry": entities.ODOMETRY_RGB, "closure": entities.CLOSURE_RGB, "pose": entities.UNCERTAINTY_RGB}


def draw_legend(name: str, facts: Mapping[str, object]) -> Drawing:
    """Yield the static parts: the style of each series, the legend, and the settings of the run."""
    for reading in entities.READINGS:
        for series in entities.SERIES:
            if series != "pose" or reading in entities.POSE_READINGS:
                path, rgb = f"{reading}/{series}", _SERIES_RGB[series]
                yield path, rr.SeriesLines(colors=rgb, names=series, widths=1.5)
                yield path, rr.SeriesPoints(colors=rgb, names=series, markers="circle", marker_sizes=3.0)
    yield entities.LEGEND, rr.TextDocument(entities.LEGEND_TEXT, media_type=rr.MediaType.MARKDOWN)
    rows = [f"| {key.replace('_', ' ')} | {_fact(value)} |" for key, value in facts.items()]
    words = "\n".join([f"### {name}", "", "| | |", "|---|---|", *rows] if rows else [f"### {name}"])
    yield entities.RUN, rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN)


def _fact(value: object) -> str:
    """Return a value as a cell of a table."""
    text = " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
    return text.replace("|", "\\|")


def draw_readings(step: Step) -> Drawing:
    """Yield the readings of the step's pairs; of several closures the one with the least rotation variance."""
    for kind in ("odometry", "closure"):
        judged = [edge for edge in step.edges if edge.kind == kind]
        if judged:
            best = min(judged, key=lambda edge: float(np.trace(edge.posterior.pose.covariance[:3, :3])))
            for reading, value in _readings(best.posterior, step).items():
                if math.isfinite(value):
                    yield f"{reading}/{kind}", rr.Scalars(value)
    covariance = step.solution.covariances.get(step.frame.index)
    if covariance is not None and np.isfinite(covariance).all():
        pose = PoseGaussian(step.solution.trajectory[step.frame.index], covariance)
        for reading, value in _sds(pose, _centre_m(step)).items():
            yield f"{reading}/pose", rr.Scalars(value)


def draw_text(step: Step, *, with_model: bool = True) -> Drawing:
    """Yield the result of the frame in words, and a log line for each pair; for `with_model` see `now_words`."""
    level = rr.TextLogLevel.INFO if step.accepted else rr.TextLogLevel.WARN
    if not step.edges and not step.last:
        yield entities.LOG, rr.TextLog(f"frame {step.frame.index}: {_outcome(step)}", level=level)
    for edge in step.edges:
        level = rr.TextLogLevel.INFO if edge.accepted else rr.TextLogLevel.WARN
        yield entities.LOG, rr.TextLog(pair_words(edge, step), level=level)
    yield entities.NOW, rr.TextDocument(now_words(step, with_model=with_model), media_type=rr.MediaType.MARKDOWN)


def _outcome(step: Step) -> str:
    return ACCEPTED if step.left_out is None else explain(step.left_out)


def pair_words(edge: Edge, step: Step) -> str:
    """Return the outcome and the readings of a pair in one line."""
    posterior = edge.posterior
    verdict = edge.kind if edge.accepted else f"{edge.kind} rejected"
    if not edge.accepted and posterior.usable:  # else the outcome is the reason
        verdict += f" ({explain(edge.reason)})"
    turned_deg = _turned_deg(posterior)
    turned = [f"turned by {turned_deg:.1f}°"] if math.isfinite(turned_deg) else []
    known = ", ".join([*turned, *certainty_words(posterior, _centre_m(step))])
    return f"{edge.source} → {edge.target} {verdict}: {posterior.outcome.label}; {known}"


def now_words(step: Step, *, with_model: bool = True) -> str:
    """Return in Markdown the outcome of the frame and of its pairs, and the state of the run.

    Args:
        step: of the frame.
        with_model: whether to say the size of the model, which is made for that.
    """
    frame = f"Frame {step.frame.index}: {'accepted' if step.accepted else 'left out'}"
    lines = [f"### {frame}{', the last' if step.last else ''}"]
    for edge in step.edges:
        lines.append(f"- **{pair_words(edge, step)}.** {edge.posterior.outcome.advice}")
        if np.isfinite(edge.posterior.pose.covariance).all():
            lines += [f"  - {words}" for words in undetermined(edge.posterior, step.view)]
        left = step.solution.mode_weights.get((edge.source, edge.target))
        if left is not None and len(left) > 1:
            lines.append(f"  - its modes in the pose graph: {', '.join(f'{100 * w:.0f}%' for w in left)}")
    if not step.edges and not step.last:
        lines.append("- The first view of the object." if step.accepted else f"- {_outcome(step)}")
    kinds = [edge.kind for edge in step.edges_so_far if edge.accepted]
    for edge in step.solution.outliers:
        kinds.remove(edge.kind)
        lines.append(f"- {edge.source} → {edge.target} {edge.kind} is left out: the other edges contradict it.")
    lines += [f"- {words}." for words in loop_words(step)] if step.last else []
    rejected = len(step.edges_so_far) - len(kinds)
    lines.append(
        f"\nSo far: views {len(step.views)}, odometry edges {kinds.count('odometry')}, spans {kinds.count('span')}, "
        f"loop closures {kinds.count('closure')}, pairs rejected {rejected}{_model_words(step) if with_model else ''}."
    )
    return "\n".join(lines)


def _model_words(step: Step) -> str:
    """Return the size of the model in words, to go on with."""
    if step.model is None:
        return "; the model has 0 points"
    triangles = f" and {len(step.model.triangles):,} triangles" if step.last else ""
    return f"; the model has {len(step.model.points_m):,} points{triangles}"


def loop_words(step: Step) -> list[str]:
    """Return in words the loop closure error before the optimisation; nothing without a loop."""
    centroids_m = {frame: view.centroid_m for frame, view in step.views.items()}
    error = loop_closure_error(step.edges_so_far, step.solution, centroids_m)
    return [] if error is None or not math.isfinite(error.sigmas) else [error.words]


def _readings(posterior: Posterior, step: Step) -> dict[str, float]:
    """Return the readings of a pair by entity path, NaN where a method does not give one."""
    return _sds(posterior.pose, _centre_m(step)) | {
        entities.TURNED: _turned_deg(posterior),
        entities.EFFECTIVE_SAMPLES: posterior.effective_samples,
        entities.OVERLAP: 100.0 * posterior.overlap,
        entities.SECONDS: posterior.seconds,
    }


def _turned_deg(posterior: Posterior) -> float:
    """Return the angle between two views."""
    return math.degrees(float(se3.rotation_angle(posterior.pose.mean)))


def _sds(pose: PoseGaussian, centre_m: Array) -> dict[str, float]:
    """Return how sure a motion is by entity path."""
    sd = sd_of(pose, centre_m)
    return {entities.ROTATION_SD: sd.rotation_deg, entities.TRANSLATION_SD: sd.translation_mm}


def _centre_m(step: Step) -> Array:
    """Return the object's centre (3,) in the frame's own camera coordinates; the camera where it was not found."""
    return np.zeros(3) if step.view is None else step.view.centroid_m


def pose_table(step: Step, chain: Mapping[int, PoseGaussian], frames: Sequence[int]) -> str:
    """Return in Markdown how sure each pose relative to the first is, before and after closure, the newest first.

    Args:
        step: with the poses after closure, and the views.
        chain: object_from_camera before closure, by frame number.
        frames: those with a pose that have a row; frames that were lost have one too.
    """
    if not step.solution.trajectory:
        return "No frame has a pose yet."
    first = next(iter(step.solution.trajectory))
    placed_by = {edge.source: edge for edge in step.edges_so_far if edge.kind == "odometry" and edge.accepted}
    lost = {edge.source: edge for edge in step.edges_so_far if edge.source not in step.solution.trajectory}
    rows = [
        f"| {frame} | lost: {lost[frame].posterior.outcome.label} | | |"
        if frame in lost
        else f"| {frame} | {' | '.join(_pose_row(step, frame, placed_by.get(frame), chain))} |"
        for frame in sorted({*frames, *lost}, reverse=True)
    ]
    return "\n".join(
        [
            f"Standard deviation of each pose relative to frame {first}, before **→ after** loop closure.",
            "",
            "| frame | turned | rotation | translation |",
            "|--:|--:|--:|--:|",
            *rows,
        ]
    )


def _pose_row(
    step: Step, frame: int, placed_by: Edge | None, chain: Mapping[int, PoseGaussian]
) -> tuple[str, str, str]:
    """Return the rotation of a frame relative to the one before, if registered to it, and its standard deviations."""
    if chain and frame == next(iter(chain)):
        return "first", "", ""
    before, after = _pose_sd(step, frame, chain.get(frame)), _pose_sd(step, frame, _solved(step, frame))
    return (
        "" if placed_by is None else f"{math.degrees(float(se3.rotation_angle(placed_by.posterior.pose.mean))):.1f}°",
        _change(before.rotation_deg, after.rotation_deg, "°"),
        _change(before.translation_mm, after.translation_mm, " mm"),
    )


def _solved(step: Step, frame: int) -> PoseGaussian | None:
    """Return the pose of a frame after closure; None if its covariance is not known."""
    covariance = step.solution.covariances.get(frame)
    return None if covariance is None else PoseGaussian(step.solution.trajectory[frame], covariance)


def _pose_sd(step: Step, frame: int, pose: PoseGaussian | None) -> Sd:
    """Return how sure a pose is, about the object's centre; NaN where that is not known."""
    if pose is None or frame not in step.views:
        return Sd(math.nan, math.nan)
    return sd_of(pose, step.views[frame].centroid_m)


def _change(before: float, after: float, unit: str) -> str:
    """Return two standard deviations, of which either may be unknown."""
    said = [f"{value:.2g}" if math.isfinite(value) else "?" for value in (before, after)]
    return f"{said[0]} **→ {said[1]}**{unit}"
