"""Readers of depth-camera sequences, and the renderer that makes synthetic ones."""

from pathlib import Path

from modeler.types import InputError
from sequences.base import AbstractSequence as AbstractSequence
from sequences.base import KeptSequence as KeptSequence
from sequences.base import frame_range as frame_range
from sequences.bop import BopSequence as BopSequence
from sequences.bop import true_mesh as true_mesh
from sequences.bop import write_bop as write_bop
from sequences.focal_length import FocalFactor as FocalFactor
from sequences.focal_length import RefocusedSequence as RefocusedSequence
from sequences.focal_length import read_focal_factor as read_focal_factor
from sequences.intrinsics import Overrides as Overrides
from sequences.noise_model import CalibratedSequence as CalibratedSequence
from sequences.noise_model import NoiseModel as NoiseModel
from sequences.noise_model import read_noise as read_noise
from sequences.opening import open_sequence as open_sequence
from sequences.survey import Survey as Survey
from sequences.survey import survey as survey
from sequences.watch import WatchLimits as WatchLimits
from sequences.watch import watch as watch


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
