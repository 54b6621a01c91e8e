"""Advice on a run: what to change, in terms of parameters, which messages name in backticks.

A `report` is that of a run, as in report.json; `edges`, `frames` and `camera` are its entries; `prior` is the run's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from modeler import se3
from modeler.priors import AutoPrior, GeneralPrior, TablePrior, TurntablePrior, turntable_in
from modeler.significance import OUTSIDE, QUORUM, SIGMAS
from modeler.types import ACCEPTED, AbstractPrior, Array, Failed, Outcome, Posterior, Reason, advice
from modeler.verdict.evidence import MAX_UNSURE

_ROUGH: Final = (
    0.25  # of a step: relative deviation of steps when an object is turned by hand (11° to 37° where 18° were intended)
)
_NEAR_LIMIT_DEG: Final = 15.0  # from the limit: the search follows poses beyond it so far (docs/method/search.md)
_MOST_OUTLIERS: Final = 0.25  # of the frames: three agree for each that does not
_FAR_DEG: Final = 100.0  # 1 % of this rotation is 1°, a third of a wrong pose
_BY_OPTIONS: Final = {
    Outcome.TOO_FEW_POINTS: (
        "The object covers too few pixels, or noise and holes leave too little of it; check the mask, `roi` and "
        "`max_depth_m`."
    ),
    Outcome.UNSURE_MASK: (
        "The object is hard to segment; give `roi`, `max_depth_m`, or masks that hold only the object."
    ),
}


def outcome_advice(outcome: Outcome, prior: AbstractPrior | None = None, posterior: Posterior | None = None) -> str:
    """Return what to do about an outcome, in terms of parameters.

    Args:
        outcome: of a frame or a registration.
        prior: of the registration.
        posterior: its result; with it and the prior, the exceeded limit is named.
    """
    if outcome is Outcome.AT_LIMIT and prior is not None and posterior is not None:
        wanted = posterior.beyond[0] if len(posterior.beyond) else posterior.pose.mean
        wider = _wider(prior, float(np.degrees(se3.rotation_angle(wanted))))
        if wider is not None:
            parameters = " ".join(f"`{name}` {value}" for name, value in wider.parameters.items())
            return f"{wider.words[0].upper()}{wider.words[1:]}: {parameters}."
    return _BY_OPTIONS.get(outcome, outcome.advice)


def reason_advice(reason: Reason, prior: AbstractPrior | None = None, posteriors: Sequence[Posterior] = ()) -> str:
    """Return what to do about a frame that was left out, in terms of parameters; "" if there is nothing to do.

    It was left out for the reason; the posteriors are its registrations.
    """
    if not isinstance(reason, Failed):
        return advice(reason)
    failed = next((posterior for posterior in posteriors if posterior.outcome is reason.outcome), None)
    return outcome_advice(reason.outcome, prior, failed)


def sign_is_ambiguous(report: Mapping[str, Any], prior: AbstractPrior) -> bool:
    """Return whether views overlap so little that a table may turn in the other direction than its prior assumes."""
    little = any(frame.get("cause") == Outcome.NO_OVERLAP.label for frame in report["frames"])
    table = turntable_in(prior)
    return little and table is not None and table.step_sign == "known"


def measured_step(edges: Sequence[Mapping[str, Any]], prior: AbstractPrior) -> str:
    """Return in words the measured step if it contradicts the prior's, else ""."""
    table, turns, sigma_deg = turntable_in(prior), *_sure_turns_deg(edges)
    if table is None or len(turns) < QUORUM:
        return ""
    found_deg, stated_deg = float(np.median(np.linalg.norm(turns, axis=1))), abs(table.step_deg)
    far_deg = SIGMAS * float(np.hypot(table.step_sigma_deg, sigma_deg))
    if abs(found_deg - stated_deg) <= far_deg or (found_deg > far_deg and not _in_one_sense(turns)):
        return ""
    signed_deg = round(float(np.copysign(found_deg, table.step_deg)), 1)
    return (
        f"the views turned by {found_deg:.1f}° from one frame number to the next, not by the given "
        f"{stated_deg:g}° ± {table.step_sigma_deg:g}°; "
        + (f"try `step_deg` {signed_deg:.1f}" if signed_deg else "did the table turn?")
    )


def step_angles_deg(edges: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return the rotations in degrees from one frame number to the next, of the least gap that occurs."""
    odometry = [edge for edge in edges if edge["accepted"] and edge["kind"] == "odometry"]
    gaps = [abs(edge["source"] - edge["target"]) for edge in odometry]  # frames tried again lie before their targets
    gap = min(gaps, default=1)
    return [
        float(np.degrees(se3.rotation_angle(np.reshape(edge["target_from_source"], (4, 4))))) / gap
        for edge, apart in zip(odometry, gaps, strict=True)
        if apart == gap
    ]


def _sure_turns_deg(edges: Sequence[Mapping[str, Any]]) -> tuple[Array, float]:
    """Return the turns from one frame number to the next, of the least gap that occurs, that edges determine.

    An edge determines one whose heaviest mode leaves all others the probability at which a pose is called wrong.

    Returns:
        Rotation vectors (n, 3) in degrees, and the median of their standard deviations.
    """
    turns, sigmas_deg = [], []
    odometry = [edge for edge in edges if edge["accepted"] and edge["kind"] == "odometry"]
    gap = min((abs(edge["source"] - edge["target"]) for edge in odometry), default=1)
    for edge in odometry:
        gaps = edge["source"] - edge["target"]
        weights = [(mode["weight_in_graph"] or 0.0) for mode in edge["modes"] if mode["weight_in_graph"] is not None]
        weights = weights or [mode["weight"] for mode in edge["modes"]]
        if abs(gaps) == gap and max(weights, default=1.0) >= (1.0 - OUTSIDE) * sum(weights):
            turns.append(np.degrees(se3.log(np.reshape(edge["target_from_source"], (4, 4)))[:3]) / gaps)
            rotation = np.reshape(edge["covariance"], (6, 6))[:3, :3]
            sigmas_deg.append(float(np.degrees(np.sqrt(np.linalg.eigvalsh(rotation)[-1]))) / gap)
    return np.reshape(turns, (-1, 3)), float(np.median(sigmas_deg)) if sigmas_deg else 0.0


def _in_one_sense(turns: Array) -> bool:
    """Return whether rotation vectors (n, 3) turn in the same sense about the axis that they share most."""
    along = turns @ np.linalg.svd(turns)[2][0]
    return bool((along > 0.0).all() or (along < 0.0).all())


def estimated_focal_length(camera: Mapping[str, Any]) -> str:
    """Return in words the focal length estimated from the graph's cycles, else ""."""
    fx_px, factor, sigma = camera.get("fx_px"), camera.get("factor_in_run", 1.0), camera["focal_factor_sigma"]
    if fx_px is None or not camera.get("loops"):
        return ""
    sds = camera["sigmas_after"], camera["sigmas_before"]
    found = focal_length_found((fx_px, sigma * fx_px), fx_px / factor, camera["loops"], sds, "as given")
    return "; ".join(filter(None, (found, contradicted_focal_length(camera))))


def contradicted_focal_length(camera: Mapping[str, Any]) -> str:
    """Return in words that the estimated focal length contradicts the given one, with likely causes, else ""."""
    if (sds := camera.get("given_sds", 0.0)) <= SIGMAS:
        return ""
    return (
        f"it contradicts the given one by {sds:.1f} of its standard deviations, which distances along the ray, "
        "a lens that is not taken out, intrinsics of another camera or image size, or depth that is "
        "wrong by a share of its relief would explain"
    )


def focal_length_found(
    found_px: tuple[float, float], given_px: float, cycles: int, sds: tuple[float, float], before: str
) -> str:
    """Return an estimate of the focal length in words.

    Args:
        found_px: the estimate and its standard deviation.
        given_px: that of the camera as given.
        cycles: number of the graph's cycles.
        sds: their closure error in standard deviations with the estimate, and before.
        before: what the second was computed with.
    """
    return (
        f"the focal length is {found_px[0]:.1f} ± {found_px[1]:.1f} px, {given_px:.1f} px was given; closure error of "
        f"{graph_cycles(cycles)}: {sds[0]:.1f} sd with it, {sds[1]:.1f} sd {before}"
    )


def graph_cycles(count: int) -> str:
    """Return a number of cycles in words."""
    return "1 graph cycle" if count == 1 else f"{count} graph cycles"


def unchecked_focal_length(report: Mapping[str, Any]) -> str:
    """Return in words the effect of a focal length error on a trusted model without a loop, else "".

    For captures with a focal length 4 to 7 % too short, the sums of rotations over a turn were too short by 0.7 to 1.0
    times as much.
    """
    turned_deg = sum(step_angles_deg(report["edges"]))
    if report["closed"] or not report["trustworthy"] or turned_deg < _FAR_DEG:
        return ""
    return (
        f"no loop checks the focal length: an error of 1 % would cause about {0.01 * turned_deg:.1f}° over the "
        f"{turned_deg:.0f}° that the object turned"
    )


@dataclass(frozen=True)
class Remedy:
    """What to do next if a model is not to be trusted."""

    words: str
    """For people."""
    parameters: Mapping[str, str] = field(default_factory=dict)
    """Of the next build, with their values; others stay as given. Empty: no new build."""
    first: str = ""
    """A command to run first; "" = none."""


def remedies(report: Mapping[str, Any], prior: AbstractPrior) -> list[Remedy]:
    """Return what to do next about the first reason not to trust a model, and about its size if that is another.

    If all that speaks against it is that few frames are left out or contradict the others, it can do without them.
    """
    # Wrong colours may cause others, lost frames follow them.
    urgency = {"colour_misaligned": 0, "left_out": 2}
    codes = sorted(report.get("reason_codes") or (), key=lambda code: urgency.get(code, 1))
    by_code: dict[str, Callable[[Mapping[str, Any], AbstractPrior], Remedy | None]] = {
        "left_out": _at_limit,
        "colour_misaligned": _without_colour,
        **dict.fromkeys(("print_contradicts", "flat_match"), _sides),
        "prior_contradicted": _without_prior,
        **dict.fromkeys(("unsure_masks", "no_motion"), _region),
        **dict.fromkeys(("loop_open", "edges_disagree"), _camera),
        "closures_refused": _camera,
        **dict.fromkeys(("free_space_violations", "false_surface"), _surface),
        **dict.fromkeys(("other_modes", "unsure_rotation", "unsure_place"), _more_known),
        "unsure_focal": _full_turn,
        "unsure_size": _known_camera,
    }
    found = ((code, by_code[code](report, prior)) for code in codes if code in by_code)
    first = [(code, each) for code, each in found if each is not None][:1]
    size = [_known_camera(report, prior)] if "unsure_size" in codes and first and first[0][0] != "unsure_size" else []
    if (without := _without_frames(report)) is not None:
        return [each for code, each in first if code == "left_out"] + [without]
    return [each for _, each in first] + size


def _without_frames(report: Mapping[str, Any]) -> Remedy | None:
    """Return how to take out frames that are left out or contradict others, if these are all that is wrong, and few."""
    codes = {*(report.get("reason_codes") or ())}
    frames = sorted(
        {int(frame) for frame in report.get("contradicted") or ()}
        | {frame["id"] for frame in report["frames"] if frame["outcome"] != ACCEPTED}
    )
    by_frames = bool(codes) and codes <= {"left_out", "free_space_violations", "false_surface"}
    if not by_frames or not 0 < len(frames) <= _MOST_OUTLIERS * len(report["frames"]):
        return None
    out = ",".join(map(str, frames))
    words = f"if the model can do without {'frame' if len(frames) == 1 else 'frames'} {out}, blurred or hidden perhaps"
    return Remedy(words, first=f"modeler edit {{run}} `drop` {out} `out` {{run}}_edited")


def _without_colour(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy:
    """Return how to do without colour."""
    return Remedy("record colour that is aligned to depth, or register by depth alone", {"no_colour": ""})


def _sides(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy:
    """Return how to tell sides that are alike apart."""
    return Remedy(
        "record again in smaller steps, from higher up and with all of the object in the image, so that each frame "
        "shows two sides or the top; or state how far it turns at most",
        {} if turntable_in(prior) is not None else {"max_rotation_deg": "DEG"},
    )


def _region(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy:
    region = {"roi": "X0 Y0 X1 Y1", "max_depth_m": "M"}
    return Remedy("specify where the object is: the pixels around it in all frames, and the largest depth", region)


def _surface(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy | None:
    """Return a check of the masks if a loop and all other checks confirm the poses, else a stronger prior."""
    if report["closed"] and set(report["reason_codes"]) <= {"free_space_violations", "false_surface", "unsure_size"}:
        words = "the loop confirms the poses; check in the report whether masks or filled holes exceed the object"
        return Remedy(words, first="modeler report {run}")
    return _more_known(report, prior)


def _camera(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy | None:
    """Return how to estimate the focal length, if a loop determines it; not again if it is that used."""
    if not any(edge["kind"] in ("closure", "join") for edge in report["edges"]):
        return _more_known(report, prior)
    camera = report.get("camera") or {}
    if camera.get("loops") and abs(np.log(camera["factor_in_run"])) <= camera["focal_factor_sigma"]:
        return Remedy(
            "the focal length that closes the loop is the one given: these images tell no more; record again in "
            "smaller steps and with more of the image on the object"
        )
    first = "modeler calibrate-camera {run} `out` camera.json"
    return Remedy("estimate the focal length from the loop, and build with it", {"camera": "camera.json"}, first)


def _full_turn(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy | None:
    """Return how to estimate the focal length of a camera that this run hardly observes."""
    if report["closed"]:
        return _camera(report, prior)
    words = "turn the object fully around, or take the focal length from another run with a full turn"
    return Remedy(words, {"camera": "camera.json"}, "modeler calibrate-camera FULL_TURN `out` camera.json")


def _known_camera(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy:
    """Return how to specify whether focal length or depth is right."""
    first = "modeler calibrate-camera {run} `known` focal-length `out` known.json"
    words = "if the given focal length is calibrated (if the depth is accurate instead: `known` depth)"
    return Remedy(words, {"camera": "known.json"}, first)


def _without_prior(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy | None:
    """Return a weaker prior; None if the measured step is reported anyway."""
    if measured_step(report["edges"], prior):
        return None
    if isinstance(prior, TurntablePrior):
        return Remedy("allow for a larger error of the step", {"step_sigma_deg": f"{3.0 * prior.step_sigma_deg:g}"})
    return Remedy("register without this prior", {"prior": "general"})


def _more_known(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy | None:
    """Return a stronger prior."""
    if turntable_in(prior) is not None:
        return None
    turns = step_angles_deg(report["edges"])
    free = prior.free if isinstance(prior, AutoPrior) else prior
    if report.get("up") is not None and isinstance(free, GeneralPrior):
        wide = max(turns, default=0.0) >= free.max_rotation_deg - _NEAR_LIMIT_DEG
        options = {"max_rotation_deg": _twice_deg(free.max_rotation_deg)} if wide else {}
        return Remedy("use the prior that the object stays on its table", {"prior": "table", **options})
    if "closures_refused" in report["reason_codes"]:  # the object came back, and the chain of steps missed it
        return _camera(report, prior)
    words, step, sigma = "give the rotation from frame to frame and its standard deviation", "DEG", "DEG"
    sure, sigma_deg = _sure_turns_deg(report["edges"])
    turned_deg = float(np.median(np.linalg.norm(sure, axis=1))) if len(sure) else 0.0
    if turns and (sigma_deg > max(_ROUGH * turned_deg, 1.0) or len(sure) < 0.5 * len(turns) or not _in_one_sense(sure)):
        words += ", which the images do not determine"
    elif turned_deg >= 1.0:
        step, sigma = f"{turned_deg:.0f}", f"{max(_ROUGH * turned_deg, 1.0):.0f}"
    return Remedy(words, {"prior": "turntable", "step_deg": step, "step_sigma_deg": sigma})


def _twice_deg(limit_deg: float) -> str:
    return f"{min(2.0 * limit_deg, 180.0):g}"


def _at_limit(report: Mapping[str, Any], prior: AbstractPrior) -> Remedy | None:
    """Return the limit to raise at which a frame was left out; None if none was at a limit."""
    lost = {frame["id"] for frame in report["frames"] if frame.get("cause") == Outcome.AT_LIMIT.label}
    edges = [edge for edge in report["edges"] if edge["source"] in lost and edge["outcome"] == Outcome.AT_LIMIT.label]
    if not edges:
        return None
    wanted = [(edge.get("beyond") or [edge["target_from_source"]])[0] for edge in edges]
    turned_deg = max(float(np.degrees(se3.rotation_angle(np.reshape(pose, (4, 4))))) for pose in wanted)
    return _wider(prior, turned_deg)


def _wider(prior: AbstractPrior, turned_deg: float) -> Remedy | None:
    """Return the limit to raise where a registration ended at a rotation at a limit; None if the prior has none."""
    if isinstance(prior, GeneralPrior | TablePrior) and turned_deg >= prior.max_rotation_deg - _NEAR_LIMIT_DEG:
        return Remedy("allow for larger rotations", {"max_rotation_deg": _twice_deg(prior.max_rotation_deg)})
    if isinstance(prior, GeneralPrior) and prior.max_offset_m is not None:
        return Remedy("allow for larger offsets", {"max_offset_m": f"{2.0 * prior.max_offset_m:g}"})
    if isinstance(prior, TablePrior | TurntablePrior) and prior.max_shift_m is not None:
        return Remedy("allow for larger shifts", {"max_shift_m": f"{2.0 * prior.max_shift_m:g}"})
    return None


def visible_frames(frames: Sequence[Mapping[str, Any]]) -> str:
    """Return in words which frames show the object if the first or the last ones do not, else "".

    If most masks are unsure, they may show a hand, and the other frames the object.
    """
    ids = sorted(frame["id"] for frame in frames)
    shown = [frame for frame in frames if frame.get("cause") != Outcome.TOO_FEW_POINTS.label]
    unsure = sum(frame.get("mask") == Outcome.UNSURE_MASK.label for frame in shown)
    seen = sorted(frame["id"] for frame in shown)
    if len(seen) < 2 or unsure > MAX_UNSURE * len(seen) or (seen[0], seen[-1]) == (ids[0], ids[-1]):
        return ""
    late, early = seen[0] > ids[0], seen[-1] < ids[-1]
    when = [f"from frame {seen[0]} on"] * late + [f"up to frame {seen[-1]}"] * early
    only = f"{seen[0] if late else ''}:{seen[-1] + 1 if early else ''}"
    return f"the object is visible {', '.join(when)}; `frames` {only} selects those frames"
