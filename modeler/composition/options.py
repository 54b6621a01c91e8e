"""Parameters of components, as a command line or a manifest gives them; docstrings and hints are its help."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final, Literal

import tyro


def default(text: str) -> object:
    """Return a help hint that states in words the value of an option that is not given."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


def _seed(words: Sequence[str]) -> int:
    """Read a seed that generators take."""
    if not words[0].isdecimal():
        raise ValueError(f"takes a whole number from 0 on, not {words[0]!r}")
    return int(words[0])


SEED = tyro.constructors.PrimitiveConstructorSpec(
    nargs=1,
    metavar="N",
    instance_from_str=_seed,
    is_instance=lambda seed: seed is None or isinstance(seed, int),
    str_from_instance=lambda seed: [str(seed)],
)
"""How a seed is read, by every command alike."""


@dataclass(frozen=True)
class ObjectOptions:
    """Where the object is. Masks of the sequence, if there are any, are cropped to it."""

    roi: Annotated[tuple[int, int, int, int] | None, tyro.conf.arg(metavar="X0 Y0 X1 Y1"), default("whole image")] = (
        None
    )
    """Look for the object within these pixels: columns X0 to X1, rows Y0 to Y1, ends not included."""
    max_depth_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("no limit")] = None
    """Largest depth of the object."""


_Three = tuple[float, float, float]


@dataclass(frozen=True)
class PriorOptions:
    """Prior on the motion between two frames."""

    prior: Annotated[str | None, tyro.conf.arg(metavar="NAME[+NAME]"), default("from sequence.json, else auto")] = None
    """general: any motion within limits of rotation and shift.
    auto: free motion, or motion on the table if one is seen; the images decide.
    table: the object stays on the table it stands on.
    turntable: it turns by a commanded step about one axis.
    held: a robot's hand carries it (robot.txt).
    poke: a finger pushes it along the table.
    Proposals only: velocity (constant velocity), features (matching features).
    module:Class: your own, an AbstractPrior that is a frozen dataclass, imported from the current folder or PYTHONPATH.
    + combines priors: held+table, features+table."""
    prior_args: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE..."), default("the class's own")] = ()
    """Fields of your own prior, values in Python syntax: step_deg=25 axis=(0,0,1) (module:Class)."""
    max_rotation_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), default("50")] = None
    """Largest rotation between two frames (general, table)."""
    max_offset_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("0.75 of the object's size")] = None
    """Largest distance between the centroids of the object in two frames (general, held)."""
    max_shift_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("0.75 of the object's size")] = None
    """Largest shift of the object on the table, or across the axis (table, turntable)."""
    step_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), default("from sequence.json")] = None
    """Turn from one frame number to the next, right-handed about the axis, which points up (turntable)."""
    step_sigma_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), default("1")] = None
    """Standard deviation of one step (turntable)."""
    step_sign: Annotated[
        Literal["known", "unknown"] | None,
        default("known if the step is negative, or the axis or sequence.json is given"),
    ] = None
    """Whether the sign of the step is known, or the table may turn in either direction (turntable)."""
    axis_direction: Annotated[
        _Three | None, tyro.conf.arg(metavar="X Y Z"), default("the table's normal if one is seen, else about up")
    ] = None
    """Direction of the axis in camera coordinates: x right, y down, z forward (turntable)."""
    axis_point_m: Annotated[_Three | None, tyro.conf.arg(metavar="X Y Z"), default("anywhere")] = None
    """A point of the axis in camera coordinates (turntable)."""
    axis_sigma_deg: Annotated[
        float | None, tyro.conf.arg(metavar="DEG"), default("1 if given, the plane's if seen, else 30 about up")
    ] = None
    """Standard deviation of the axis' direction; 180: any direction (turntable)."""
    axis_sigma_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("0.005")] = None
    """Standard deviation of the axis' point (turntable)."""
    held_sigma_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), default("3")] = None
    """Standard deviation of slip and calibration error in the rotation of one motion, about each axis (held)."""
    held_sigma_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("0.008")] = None
    """Standard deviation of slip and calibration error in the shift of one motion, along each axis (held)."""
    max_gap_s: Annotated[float | None, tyro.conf.arg(metavar="S"), default("1")] = None
    """Poses of the hand farther apart in time than this are not interpolated (held)."""
    regrasp_probability: Annotated[float | None, tyro.conf.arg(metavar="P"), default("0.02")] = None
    """Probability of a regrasp from one frame to the next (held)."""
    poke_point_m: Annotated[_Three | None, tyro.conf.arg(metavar="X Y Z"), default("from sequence.json")] = None
    """Point where the finger first touches the object, in camera coordinates (poke)."""
    poke_direction: Annotated[_Three | None, tyro.conf.arg(metavar="X Y Z"), default("from sequence.json")] = None
    """Direction of the finger's motion in camera coordinates (poke)."""
    poke_length_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("from sequence.json")] = None
    """Length of the push (poke)."""
    velocity_sigma_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), default("5")] = None
    """Standard deviation of the change of rotation from one motion to the next, about each axis (velocity)."""
    velocity_sigma_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("0.01")] = None
    """Standard deviation of the change of shift from one motion to the next, along each axis (velocity)."""

    def given(self, name: str, accepted: Collection[str], of: Mapping[str, Collection[str]]) -> dict[str, Any]:
        """Return the parameters that were given, by field name.

        Raises:
            InputError: if a parameter of another prior was given, or a value that is none.
        """
        from modeler.types import InputError
        from modeler.types.base import ParameterError, check_parameter

        given = self.parameters()
        for parameter in sorted(given.keys() - set(accepted)):
            others = " or ".join(prior for prior, parameters in of.items() if parameter in parameters)
            raise InputError(
                f"`{parameter}` is not a parameter of `prior` {name}; leave it out, or give `prior` {others}."
            )
        for parameter, value in given.items():
            try:
                check_parameter(parameter, value, exact=False)
            except ParameterError as error:
                raise InputError(f"`{parameter}` {error.fault}.") from error
        return given

    def parameters(self) -> dict[str, Any]:
        """Return all parameters that were given, by field name."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("prior", "prior_args")}
        return {name: value for name, value in values.items() if value is not None}


Method = Literal["visibility", "paper", "icp", "gicp", "coloured-icp", "fpfh", "fpfh-icp", "kiss"]
OF_EXTRAS: Final[tuple[Method, ...]] = ("kiss",)  # methods that need an extra; they run only if named


@dataclass(frozen=True)
class MethodOptions:
    """How two frames are registered."""

    method: Method = "visibility"
    """visibility: ours. paper: Wüthrich et al. 2012. The others are baselines (kiss needs the extra peers)."""
    colour: Annotated[bool, default("compare, if frames have colour")] = True
    """Do not compare the colours of matching surface."""
    device: Annotated[Literal["cpu", "cuda"] | None, default("cuda if present and faster, else cpu")] = None
    """Where poses are sampled and scored: cuda needs an NVIDIA GPU and the extra gpu, and --method paper."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""
