"""Models of objects from depth-camera sequences, with calibrated registration uncertainty.

A fixed depth camera watches a rigid object that is turned or moved. Pairs of depth images are registered by a
probabilistic method, whose posteriors become the factors of a pose graph; its optimised poses fuse the images into a
mesh. The method is that of M. Wüthrich et al., "Probabilistic Depth Image Registration incorporating Nonvisual
Information", ICRA 2012, and its extensions; see `docs/method`.

Two depth images to a relative pose and its covariance:

    import modeler

    posterior = modeler.register(source_depth_m, target_depth_m, (fx, fy, cx, cy))
    posterior.outcome, posterior.pose.mean, posterior.pose.covariance

A sequence to a model, in a run folder as `modeler build` writes it:

    result = modeler.build("sequences/bundled/box", "runs/box", prior="table")
    result.trustworthy, result.model.vertices_m, result.solution.trajectory

The frames may come from a program, and every event of the run go to functions of its own:

    frames = (modeler.Frame.of(depth_m, (fx, fy, cx, cy), number) for number, depth_m in enumerate(depths_m))
    result = modeler.build(frames, sinks=[print])

An object found in new images with its model, and followed:

    tracker = modeler.Tracker(modeler.known_object("runs/box").model)
    found = tracker.update(modeler.Frame(0, 0.0, depth_m, camera))
    found.outcome, found.pose.mean, found.pose.covariance, found.modes

Frames and units
    Lengths are in m, angles in rad unless a name ends with `_deg`; depth is the distance along the optical axis, with 0
    or NaN where nothing was measured. Camera frames have x right, y down, z forward. `target_from_source` is the (4, 4)
    transform that maps points from the source's camera frame to the target's. The object frame is the camera frame of
    the first accepted view; a trajectory holds `object_from_camera` by frame number. A covariance (6, 6) is of
    the tangent vector (rotation, translation) of `mean @ exp(xi)`, in the frame on the right.

Components are frozen dataclasses, whose fields are their parameters: a `Modeler` is made of a segmenter, a sensor, a
prior, a registrar, a closer and a fuser, each replaceable. `modeler.types` has the abstract interfaces.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modeler.api import Result as Result
    from modeler.api import build as build
    from modeler.api import register as register
    from modeler.pipeline import Modeler as Modeler
    from modeler.priors import FeaturesPrior as FeaturesPrior
    from modeler.priors import GeneralPrior as GeneralPrior
    from modeler.priors import HeldPrior as HeldPrior
    from modeler.priors import PokePrior as PokePrior
    from modeler.priors import ProductPrior as ProductPrior
    from modeler.priors import TablePrior as TablePrior
    from modeler.priors import TurntablePrior as TurntablePrior
    from modeler.priors import VelocityPrior as VelocityPrior
    from modeler.registration import VisibilityRegistrar as VisibilityRegistrar
    from modeler.runs.known_objects import KnownObject as KnownObject
    from modeler.runs.known_objects import known_object as known_object
    from modeler.segmentation import Segmenter as Segmenter
    from modeler.sequences import open_sequence as open_sequence
    from modeler.tracking import Tracked as Tracked
    from modeler.tracking import Tracker as Tracker
    from modeler.types import Camera as Camera
    from modeler.types import Frame as Frame
    from modeler.types import InputError as InputError
    from modeler.types import ObjectModel as ObjectModel
    from modeler.types import Outcome as Outcome
    from modeler.types import PoseGaussian as PoseGaussian
    from modeler.types import Posterior as Posterior
    from modeler.types import SensorNoise as SensorNoise
    from modeler.types import Solution as Solution
    from modeler.types import Step as Step
    from modeler.types import Verdict as Verdict
    from modeler.views import Sensor as Sensor
    from modeler.viz.stream import open_stream as open_stream

_MODULES = {
    "modeler.api": ("Result", "build", "register"),
    "modeler.pipeline": ("Modeler",),
    "modeler.priors": (
        "FeaturesPrior",
        "GeneralPrior",
        "HeldPrior",
        "PokePrior",
        "ProductPrior",
        "TablePrior",
        "TurntablePrior",
        "VelocityPrior",
    ),
    "modeler.views": ("Sensor",),
    "modeler.registration": ("VisibilityRegistrar",),
    "modeler.runs.known_objects": ("KnownObject", "known_object"),
    "modeler.segmentation": ("Segmenter",),
    "modeler.tracking": ("Tracked", "Tracker"),
    "modeler.types": (
        "Camera",
        "Frame",
        "InputError",
        "ObjectModel",
        "Outcome",
        "PoseGaussian",
        "Posterior",
        "SensorNoise",
        "Solution",
        "Step",
        "Verdict",
    ),
    "modeler.sequences": ("open_sequence",),
    "modeler.viz.stream": ("open_stream",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = tuple(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used (PEP 562), so that `import modeler` costs nothing."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
