"""Readers of depth-camera sequences, and the renderer that makes synthetic ones.

Whatever reads raises `InputError`, in one line, where it cannot; docstrings within the package do not repeat it.
"""

from pathlib import Path

from modeler.sequences.base import AbstractSequence as AbstractSequence
from modeler.sequences.base import GivenSequence as GivenSequence
from modeler.sequences.base import KeptSequence as KeptSequence
from modeler.sequences.base import frame_range as frame_range
from modeler.sequences.bop import BopSequence as BopSequence
from modeler.sequences.bop import finest_unit_mm as finest_unit_mm
from modeler.sequences.bop import scene_meta as scene_meta
from modeler.sequences.bop import true_mesh as true_mesh
from modeler.sequences.bop import write_bop as write_bop
from modeler.sequences.calibrated import CalibratedSequence as CalibratedSequence
from modeler.sequences.calibrated import FocalFactor as FocalFactor
from modeler.sequences.calibrated import NoiseModel as NoiseModel
from modeler.sequences.calibrated import RefocusedSequence as RefocusedSequence
from modeler.sequences.calibrated import read_focal_factor as read_focal_factor
from modeler.sequences.calibrated import read_noise as read_noise
from modeler.sequences.intrinsics import Overrides as Overrides
from modeler.sequences.opening import WatchLimits as WatchLimits
from modeler.sequences.opening import open_sequence as open_sequence
from modeler.sequences.opening import watch as watch
from modeler.sequences.survey import Survey as Survey
from modeler.sequences.survey import survey as survey
from modeler.types import InputError


def bundled(name: str) -> Path:
    """Return the folder of a sequence that comes with the package: `box`, `flashlight` or `tube`.

    Raises:
        InputError: if there is none of that name.
    """
    folder = Path(__file__).parent / "bundled"
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    if name not in names:
        raise InputError(f"no bundled sequence is called {name!r}; there are {', '.join(names)}.")
    return folder / name
