"""Options to components."""

from __future__ import annotations

from modeler import registration
from modeler.cli import nonvisual
from modeler.cli.options import Method, MethodOptions, ObjectOptions, PriorOptions
from modeler.closure import Closer
from modeler.fusion import Fuser
from modeler.pipeline import Modeler, glancing
from modeler.rays import Sensor
from modeler.segmentation import Scene, Segmenter, telling
from modeler.types import AbstractRegistrar, InputError
from sequences import AbstractSequence


def modeler(
    sequence: AbstractSequence, prior_options: PriorOptions, method: MethodOptions, where: ObjectOptions
) -> Modeler:
    """Return the loop with the parts asked for, its sensor as the sequence describes it, else the first Kinect's.

    Raises:
        InputError: where an option cannot be used.
    """
    check_region(where, sequence)
    noise, chosen = sequence.sensor(), registrar(method.method)
    return Modeler(
        segmenter=segmenter(where),
        sensor=Sensor() if noise is None else Sensor(*noise),
        prior=nonvisual.prior(prior_options, sequence),
        registrar=chosen,
        glance=glancing(chosen),
        closer=Closer(),
        fuser=Fuser(),
        seed=method.seed,
    )


def check_region(where: ObjectOptions, sequence: AbstractSequence) -> None:
    """Refuse a region of the image in which nothing can be.

    Raises:
        InputError: where it lies outside the first frame.
    """
    if where.roi is None:
        return
    camera = sequence.frame(sequence.indices[0]).camera
    if where.roi[0] >= camera.width or where.roi[1] >= camera.height:
        raise InputError(
            f"--roi {' '.join(map(str, where.roi))} lies outside the images of {sequence.name}, which are "
            f"{camera.width} x {camera.height} pixels; move it there"
        )


def segmenter(options: ObjectOptions) -> Segmenter:
    """Return the segmenter with the limits asked for."""
    return Segmenter(roi=options.roi, max_depth_m=options.max_depth_m)


def scene(modeler: Modeler, sequence: AbstractSequence) -> Scene:
    """Return what frames spread over the whole sequence teach the segmenter."""
    return modeler.segmenter.scene([sequence.frame(index) for index in telling(sequence.indices)])


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
