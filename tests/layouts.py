"""Folders as other programs write them, and whether what is read is what was written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from recordings import write_bundlesdf, write_open3d, write_tum

from modeler.types import Frame

Writer = Callable[[Path, list[Frame], dict[int, np.ndarray] | None], None]
WRITERS: dict[str, Writer] = {"TUM RGB-D": write_tum, "Open3D": write_open3d, "BundleSDF": write_bundlesdf}
