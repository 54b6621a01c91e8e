"""From options and the metadata of a sequence to components."""

from __future__ import annotations

import ast
import importlib
import itertools
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, Literal

from modeler import baselines, registration
from modeler.baselines import fpfh
from modeler.closure import Closer
from modeler.composition.options import Method, MethodOptions, ObjectOptions, PriorOptions
from modeler.fusion import Fuser
from modeler.kernels import gpu
from modeler.pipeline import Modeler
from modeler.priors import (
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
    turntable_in,
)
from modeler.segmentation import Scene, Segmenter, scene_frames
from modeler.sequences import AbstractSequence
from modeler.sequences.file_names import said_of_angles
from modeler.sequences.hand_shapes import hand_poses
from modeler.types import NOMINAL_FOCAL, AbstractPrior, AbstractRegistrar, InputError, SensorNoise
from modeler.types.base import ParameterError
from modeler.views import Sensor

_GIVEN = {
    "auto": (),
    "general": ("max_rotation_deg", "max_offset_m"),
    "table": ("max_rotation_deg", "max_shift_m"),
    "turntable": (
        "step_deg",
        "step_sigma_deg",
        "step_sign",
        "axis_direction",
        "axis_point_m",
        "axis_sigma_deg",
        "axis_sigma_m",
        "max_shift_m",
    ),
    "held": ("held_sigma_deg", "held_sigma_m", "max_gap_s", "max_offset_m", "regrasp_probability"),
    "poke": ("poke_point_m", "poke_direction", "poke_length_m"),
    "velocity": ("velocity_sigma_deg", "velocity_sigma_m"),
    "features": (),
}
_GUESSES = ("velocity", "features")


def modeler(
    sequence: AbstractSequence, prior_options: PriorOptions, method: MethodOptions, where: ObjectOptions
) -> Modeler:
    """Return the loop with the parts asked for, its sensor as the sequence describes it, else of unknown noise.

    Raises:
        InputError: if an option cannot be used.
    """
    check_region(where, sequence)
    noise, chosen = sequence.sensor(), registrar(method.method, colour=method.colour, device=method.device)
    sensor = Sensor(SensorNoise(sigma_r_m=None, sigma_focal=NOMINAL_FOCAL) if noise is None else noise)
    return Modeler(
        segmenter=segmenter(where),
        sensor=sensor,
        prior=chosen_prior(prior_options, sequence),
        registrar=chosen,
        closer=Closer(),
        fuser=Fuser(),
        colour=method.colour,
        seed=method.seed,
    )


def check_region(where: ObjectOptions, sequence: AbstractSequence) -> None:
    """Refuse a region that is not part of the image."""
    if where.roi is None:
        return
    camera = sequence.frame(sequence.indices[0]).camera
    if where.roi[2] > camera.width or where.roi[3] > camera.height:
        raise InputError(
            f"`roi` {' '.join(map(str, where.roi))} reaches outside the images of {sequence.name}, which are "
            f"{camera.width} x {camera.height} pixels; give X1 up to {camera.width} and Y1 up to {camera.height}"
        )


def segmenter(options: ObjectOptions) -> Segmenter:
    """Return the segmenter with the limits asked for."""
    return Segmenter(roi=options.roi, max_depth_m=options.max_depth_m)


def scene(modeler: Modeler, sequence: AbstractSequence, frames: Sequence[int] = ()) -> Scene:
    """Return the scene that the segmenter learns.

    Args:
        modeler: has the segmenter.
        sequence: of the scene.
        frames: numbers of those to learn it from; none: frames spread over the sequence.
    """
    return modeler.segmenter.scene([sequence.frame(index) for index in frames or scene_frames(sequence.indices)])


def registrar(
    method: Method, *, colour: bool = True, device: Literal["cpu", "cuda"] | None = None
) -> AbstractRegistrar:
    """Return the registration method of a name.

    Raises:
        InputError: if it cannot be there, or is not installed.
    """
    if device == "cuda":
        if method != "paper":
            raise InputError(f"`device` cuda: `method` {method} runs on the CPU only; leave `device` out")
        if (fault := gpu.missing()) is not None:
            raise InputError(f"`device` cuda: {fault}")
    match method:
        case "visibility":
            return registration.VisibilityRegistrar(registration.VisibilityLikelihood(colour=colour))
        case "paper":
            return baselines.PaperRegistrar(device=device or "auto")
        case "icp":
            return baselines.IcpRegistrar()
        case "gicp":
            return baselines.GicpRegistrar()
        case "coloured-icp":
            return baselines.ColouredIcpRegistrar()
        case "fpfh":
            return baselines.FpfhRegistrar()
        case "fpfh-icp":
            return baselines.FpfhIcpRegistrar()
        case "kiss":
            fpfh.check_kiss()
            return baselines.KissIcpRegistrar()


def chosen_prior(options: PriorOptions, sequence: AbstractSequence | None) -> AbstractPrior:
    """Return the requested prior of a sequence, or of several where that is None.

    Raises:
        InputError: if there is no such prior, a parameter cannot be used, or the sequence lacks what it needs.
    """
    name = prior_name(options, sequence)
    parts = name.split("+")
    for part in parts:
        if part not in _GIVEN and ":" not in part:
            raise InputError(
                f"`prior` {name}: unknown prior {part!r}; known are {', '.join(map(repr, _GIVEN))}, "
                "your own as module:Class, and several joined by +"
            )
        if parts.count(part) > 1:
            raise InputError(f"`prior` {name} names {part} twice; name each once")
    known = [part for part in parts if part not in _GUESSES] or ["general"]
    own = sum(part not in _GIVEN for part in known)
    if own > 1 or (options.prior_args and not own):
        raise InputError("`prior_args` are the fields of one prior of your own; give `prior` module:Class once")
    accepted = {parameter for part in (*parts, *known) for parameter in _GIVEN.get(part, ())}
    given = options.given(name, accepted, _GIVEN)
    of = {part: {key: value for key, value in given.items() if key in _GIVEN[part]} for part in _GIVEN}
    if {"table", "turntable"} <= set(known):  # the axis is the table's normal: to multiply would count the table twice
        if "max_rotation_deg" in given:
            raise InputError(
                "`max_rotation_deg` is not a parameter of a turntable on its table; `step_deg` gives the rotation."
            )
        known.remove("table")
        of["turntable"]["needs_table"] = True
    try:
        found = [
            _known(part, of[part], sequence) if part in _GIVEN else _own_prior(part, options.prior_args)
            for part in known
        ]
    except ParameterError as error:  # options are checked already
        where = "" if sequence is None else f"{sequence.name}: sequence.json: "
        raise InputError(f"{where}{error}.") from error
    result = found[0]
    for other in found[1:]:
        result = ProductPrior(result, other)
    for guess in (part for part in parts if part in _GUESSES):
        result = VelocityPrior(result, **of[guess]) if guess == "velocity" else FeaturesPrior(result)
    return result


def prior_name(options: PriorOptions, sequence: AbstractSequence | None) -> str:
    """Return the name of the requested prior; without one, that of the sequence if it is complete, else `auto`.

    Parameters without a name are those of `general`.
    """
    if options.prior is not None:
        return options.prior
    motion = {} if sequence is None else sequence.motion or {}
    kind = str(motion.get("kind"))
    enough: Mapping[str, Callable[[], object]] = {
        "general": lambda: True,
        "table": lambda: True,
        "turntable": lambda: options.step_deg is not None or motion.get("step_deg"),
        "held": lambda: sequence is not None and sequence.robot_path is not None,
        "poke": lambda: "pokes" in motion,
    }
    # Parameters of another prior, given by hand, say more than the file.
    fits = options.parameters().keys() <= set(_GIVEN.get(kind, ()))
    otherwise = "general" if options.parameters() or kind == "held" else "auto"  # what is held is on no table
    return kind if fits and kind in enough and enough[kind]() else otherwise


def resolved_prior(options: PriorOptions, sequence: AbstractSequence) -> tuple[str, str]:
    """Return the name of the prior, and in words the assumptions not given by an option.

    Raises:
        InputError: if the frames would be half a turn or more apart.
    """
    name, assumed = prior_name(options, sequence), []
    if options.prior is None and name not in ("auto", "general"):
        assumed.append(f"prior {name}, from sequence.json")
    step_deg = (sequence.motion or {}).get("step_deg")
    if "turntable" in name.split("+") and options.step_deg is None and step_deg is not None:
        assumed.append(f"step {step_deg:g}°, from sequence.json")
    step_deg = step_deg if options.step_deg is None else options.step_deg
    apart = min((late - early for early, late in itertools.pairwise(sequence.indices)), default=1)
    # No table turns by more than half a turn from frame to frame.
    if "turntable" in name.split("+") and step_deg is not None and apart > 1 and apart * abs(step_deg) > 180.0:
        raise InputError(
            f"`step_deg` {step_deg:g} is from one frame number to the next, and these go up by {apart}, as angles in "
            f"names do: frames would be {apart * step_deg:g}° apart; if the names are angles, give `step_deg` 1"
        )
    if "turntable" in name.split("+") and step_deg is not None and apart > 1:
        assumed.append(
            f"frame numbers go up by {apart}: {step_deg:g}° from one number to the next is {apart * step_deg:g}° from "
            "frame to frame"
        )
    return name, "; ".join((*assumed, *sequence.notes))


def comes_back(frames: AbstractSequence, prior: AbstractPrior, reach_deg: float) -> bool:
    """Return whether the given rotations bring the object back to its first view, or nearly.

    Args:
        frames: the sequence, which may have the rotation from frame to frame.
        prior: of the run, whose turntable takes precedence.
        reach_deg: largest rotation across which views are registered.
    """
    table = turntable_in(prior)
    step_deg = (frames.motion or {}).get("step_deg") if table is None else table.step_deg
    return step_deg is not None and abs(step_deg) * (frames.indices[-1] - frames.indices[0]) >= 360.0 - reach_deg


def _known(name: str, given: dict[str, Any], sequence: AbstractSequence | None) -> AbstractPrior:
    """Return a prior that is evidence, by its name."""
    match name:
        case "auto":
            return AutoPrior()
        case "table":
            return TablePrior(**given, limits_assumed=not given)
        case "turntable":
            if sequence is None:
                return _turntable(given, {}, ())
            return _turntable(given, sequence.motion or {}, () if sequence.live else sequence.indices)
        case "held":
            return _held(given, sequence)
        case "poke":
            return _poke(given, sequence)
        case _:
            return GeneralPrior(**given, limits_assumed=not given)


def _own_prior(name: str, arguments: Sequence[str]) -> AbstractPrior:
    """Return a prior that a user wrote."""
    module_name, _, class_name = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        kind = getattr(importlib.import_module(module_name), class_name)
    except Exception as error:  # whatever a user's module raises
        raise InputError(f"`prior` {name}: cannot be imported ({type(error).__name__}: {error}); correct it") from error
    frozen = getattr(getattr(kind, "__dataclass_params__", None), "frozen", False)
    if not (isinstance(kind, type) and issubclass(kind, AbstractPrior) and is_dataclass(kind) and frozen):
        raise InputError(f"`prior` {name}: is not a prior; derive a frozen dataclass from modeler.types.AbstractPrior")
    known = {field.name for field in fields(kind) if field.init}
    values = {}
    for argument in arguments:
        field, equals, text = argument.partition("=")
        if not equals or field not in known:
            raise InputError(
                f"`prior_args` {argument}: {class_name} has {', '.join(sorted(known)) or 'no fields'}; give NAME=VALUE"
            )
        try:
            values[field] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            values[field] = text
    try:
        prior = kind(**values)
    except Exception as error:
        raise InputError(f"`prior` {name}: cannot be created ({error}); see `prior_args`") from error
    assert isinstance(prior, AbstractPrior)
    return prior


def options_of(prior: AbstractPrior) -> PriorOptions:
    """Return the options by which a run's prior can be made again, if its module can be imported.

    Fields that are other objects, such as priors of a product, are left out.
    """
    known = fields(prior) if is_dataclass(prior) else ()
    given = {field.name: getattr(prior, field.name) for field in known if field.init}
    usual = {field.name: field.default for field in known}
    words = tuple(f"{name}={value!r}" for name, value in given.items() if _literal(value) and value != usual[name])
    return PriorOptions(prior=f"{type(prior).__module__}:{type(prior).__qualname__}", prior_args=words)


def _literal(value: object) -> bool:
    """Return whether a value can be read from what it is printed as."""
    try:
        return bool(ast.literal_eval(repr(value)) == value)
    except (ValueError, SyntaxError):
        return False


def _turntable(given: dict[str, Any], motion: Mapping[str, Any], indices: Sequence[int]) -> TurntablePrior:
    """Return a turntable, its step as given, else from `sequence.json`.

    A step given without an axis leaves its sign unknown, unless it is negative or agrees with the file.
    """
    step_deg, sigma_deg = motion.get("step_deg"), motion.get("sigma_deg")
    given = dict(given)
    if "step_deg" not in given:
        if not step_deg:
            looks = "".join(f" ({said})" for said in said_of_angles(indices))
            raise InputError(f"`prior` turntable needs the rotation from frame to frame; give `step_deg`{looks}")
        given["step_deg"] = step_deg
        if sigma_deg:
            given.setdefault("step_sigma_deg", sigma_deg)
    agreed = step_deg is not None and step_deg * given["step_deg"] > 0.0
    signed = given["step_deg"] < 0.0 or "axis_direction" in given or agreed
    given.setdefault("step_sign", "known" if signed else "unknown")
    return TurntablePrior(**given)


def _held(given: dict[str, Any], sequence: AbstractSequence | None) -> HeldPrior:
    """Return the hand of a sequence."""
    if sequence is None:
        raise InputError("`prior` held reads the robot.txt of one sequence; give one sequence at a time")
    if sequence.robot_path is None:
        raise InputError(
            f"{sequence.name}: has no robot.txt for `prior` held; write lines `time tx ty tz qx qy qz qw` of "
            "camera_from_hand there, or use another prior"
        )
    hand = hand_poses(sequence.robot_path)
    max_gap_s = given.get("max_gap_s", hand.max_gap_s)
    others = {name: value for name, value in given.items() if name != "max_gap_s"}
    return HeldPrior(replace(hand, max_gap_s=max_gap_s), **others)


def _poke(given: dict[str, Any], sequence: AbstractSequence | None) -> PokePrior:
    """Return the given push, or those of `sequence.json`."""
    if given:
        missing = [name for name in _GIVEN["poke"] if name not in given]
        if missing:
            raise InputError(f"`prior` poke needs `{missing[0]}` as well; give all three")
        return PokePrior(Poke(given["poke_point_m"], given["poke_direction"], given["poke_length_m"]))
    pokes = None if sequence is None else (sequence.motion or {}).get("pokes")
    if not pokes:
        raise InputError("`prior` poke needs `poke_point_m`, `poke_direction` and `poke_length_m`; give them")
    read = {int(k): Poke(tuple(e["point_m"]), tuple(e["direction"]), e["length_m"]) for k, e in pokes.items()}
    return PokePrior(pokes=read)
