"""Options that several commands share, grouped as help shows them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions, default

if TYPE_CHECKING:
    from modeler.sequences import Overrides


MIN_VOXEL_M = 1e-5  # no camera resolves less; a model of such voxels fits into no memory


def check_voxel(voxel_m: float | None) -> None:
    """Refuse a side of voxels that is out of range."""
    from modeler.types import InputError

    if voxel_m is not None and not MIN_VOXEL_M <= voxel_m < 1.0:
        raise InputError(f"--voxel-m {voxel_m:g} is out of range; give a length in m from {MIN_VOXEL_M:g} to 1")


@dataclass(frozen=True)
class MovedOptions:
    """Where the sequence is now, if it has moved since the run was made."""

    sequence: Annotated[
        tuple[Path, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="SEQUENCE"),
        default("as in RUN"),
    ] = ()
    """The sequence; of a joined run, once for each of its parts, in order."""


StrictPaths = Annotated[
    bool,
    tyro.conf.arg(help="Reject sequences with links that lead out of them; else links are followed, for reading only."),
]
"""`--strict-paths`, of every command that opens sequences."""


@dataclass(frozen=True)
class ModelOptions:
    """Camera calibration and resolution of the model."""

    sensor: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("from SEQUENCE")] = None
    """Noise of the depth camera, as `modeler calibrate-sensor` measured it."""
    camera: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("from SEQUENCE")] = None
    """Focal length of the depth camera, as `modeler calibrate-camera` estimated it."""
    voxel_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("from the data")] = None
    """Side of a voxel of the model."""
    tolerance_mm: Annotated[
        float | None, tyro.conf.arg(metavar="MM"), default("7.5 % of the object's size, at least 2.5 sd of the noise")
    ] = None
    """Error of the surface up to which the model serves its purpose; exit status 0 promises to keep it."""


@dataclass(frozen=True)
class FrameOptions:
    """Selection of frames."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use the first frame and every N-th after it."""
    frames: Annotated[str, tyro.conf.arg(metavar="A:B"), default("all")] = ":"
    """Use frame numbers from A up to, but not including, B; either may be left out."""


@dataclass(frozen=True)
class WatchOptions:
    """A sequence that is still being written, and a viewer."""

    watch: bool = False
    """Process frames while another program is still writing into SEQUENCE."""
    idle_s: Annotated[float, tyro.conf.arg(metavar="S")] = 10.0
    """With --watch: end the sequence after so long without a new frame (or at a file `done`, or at Ctrl-C)."""
    view: bool = False
    """Watch in the Rerun viewer."""
    web: bool = False
    """Watch in the browser, served on 127.0.0.1 only."""


def given_options(*groups: object) -> dict[str, tuple[object, ...]]:
    """Return the options of groups that have other values than their defaults, each with its values."""
    found: dict[str, tuple[object, ...]] = {}
    for group in groups:
        for one in fields(group):  # pyright: ignore[reportArgumentType]
            value = getattr(group, one.name)
            if value != one.default:
                name = f"--{'no-' if value is False else ''}{one.name.replace('_', '-')}"
                found[name] = () if isinstance(value, bool) else value if isinstance(value, tuple) else (value,)
    return found


@dataclass(frozen=True)
class InputOptions:
    """Values that override the input's."""

    intrinsics: Annotated[
        tuple[float, float, float, float] | None, tyro.conf.arg(metavar="FX FY CX CY"), default("from the input")
    ] = None
    """Intrinsics of the depth camera in px."""
    depth_scale_mm: Annotated[float | None, tyro.conf.arg(metavar="MM"), default("from the input")] = None
    """Millimetres per unit of stored depth."""
    depth_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC"), default("the only one")] = None
    """Topic of the depth images in a ROS bag."""
    colour_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC"), default("the one aligned to depth")] = None
    """Topic of the colour images in a ROS bag."""
    along_ray: bool = False
    """Stored depth is the distance along the ray, as renderers write it, not along the optical axis."""
    despite_doubts: bool = False
    """Use the input although depth or colour are plainly not what they seem (`modeler info` says why)."""
    strict_paths: StrictPaths = False

    def overrides(self) -> Overrides:
        """Return them for the readers of sequences."""
        from modeler.sequences import Overrides

        return Overrides(**{name: value for name, value in asdict(self).items() if name != "despite_doubts"})

    def settings(self) -> dict[str, object]:
        """Return what was given, as recorded in report.json."""
        unrecorded = ("despite_doubts", "strict_paths")
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) and f.name not in unrecorded}


@dataclass(frozen=True, kw_only=True)
class AbstractBuild:
    """Options that builds have alone and in a batch."""

    model: ModelOptions = field(default_factory=ModelOptions)
    prior: PriorOptions = field(default_factory=PriorOptions)
    method: MethodOptions = field(default_factory=MethodOptions)
    selection: FrameOptions = field(default_factory=FrameOptions)
    where: ObjectOptions = field(default_factory=ObjectOptions)
    given: InputOptions = field(default_factory=InputOptions)

    def arguments(self) -> tuple[str, ...]:
        """Return the command line that gives these options the values they have; files by absolute paths."""
        groups = (getattr(self, one.name) for one in fields(AbstractBuild))
        words: list[str] = []
        for name, values in given_options(*groups).items():
            words += [name, *(str(value.absolute() if isinstance(value, Path) else value) for value in values)]
        return tuple(words)
