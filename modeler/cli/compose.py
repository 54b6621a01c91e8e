"""Options to components."""

from __future__ import annotations

from pathlib import Path

import sequences
from modeler import registration
from modeler.cli import nonvisual
from modeler.cli.options import Method, MethodOptions, ObjectOptions, PriorOptions
from modeler.closure import Closer
from modeler.fusion import Fuser
from modeler.pipeline import Modeler
from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter, telling
from modeler.types import AbstractPrior, AbstractRegistrar
from sequences import AbstractSequence


def open_sequence(path: Path) -> AbstractSequence:
    """Open the sequence in a folder."""
    return sequences.open_sequence(path)


def modeler(
    sequence: AbstractSequence, prior_options: PriorOptions, method: MethodOptions, where: ObjectOptions
) -> Modeler:
    """Return the loop with the parts asked for, its sensor as the sequence describes it, else the first Kinect's.

    Raises:
        InputError: where an option cannot be used.
    """
    noise = sequence.sensor()
    return Modeler(
        segmenter=segmenter(where),
        sensor=Sensor() if noise is None else Sensor(*noise),
        prior=prior(prior_options, sequence),
        registrar=registrar(method.method),
        closer=Closer(),
        fuser=Fuser(),
        seed=method.seed,
    )


def segmenter(options: ObjectOptions) -> Segmenter:
    """Return the segmenter with the limits asked for."""
    return Segmenter(roi=options.roi, max_depth_m=options.max_depth_m)


def scene(modeler: Modeler, sequence: AbstractSequence) -> Scene:
    """Return what frames spread over the whole sequence teach the segmenter."""
    return modeler.segmenter.scene([sequence.frame(index) for index in telling(sequence.indices)])


def prior(options: PriorOptions, sequence: AbstractSequence | None = None) -> AbstractPrior:
    """Return the prior asked for, or that `sequence.json` asks for.

    Raises:
        InputError: where there is no such prior, a parameter cannot be used, or the sequence lacks what it needs.
    """
    return nonvisual.prior(options, sequence)


def told_prior(options: PriorOptions, sequence: AbstractSequence) -> tuple[str, str]:
    """Return the name of the prior, and in words what was chosen or assumed without being asked for."""
    name = nonvisual.prior_name(options, sequence)
    said = () if options.prior is not None or name == "general" else (f"prior {name}, as sequence.json says",)
    return name, "; ".join((*said, *sequence.notes))


def registrar(method: Method) -> AbstractRegistrar:
    """Return the registration method of a name."""
    match method:
        case "visibility":
            return registration.VisibilityRegistrar()
        case "paper":
            return registration.PaperRegistrar()
        case "icp":
            return registration.IcpRegistrar()
        case "gicp":
            return registration.GicpRegistrar()
        case "fpfh":
            return registration.FpfhRegistrar()
        case "fpfh-icp":
            return registration.FpfhIcpRegistrar()
