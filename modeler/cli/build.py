"""`modeler build`: a sequence to a model."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.options import FrameOptions, MethodOptions, ObjectOptions, PriorOptions, default


@dataclass(frozen=True)
class Build:
    """Build the model of an object from a sequence: register its frames, close loops, fuse.

    Ctrl-C ends the run with the frames so far, and makes the model from them.
    """

    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of pictures (BOP, TUM RGB-D, Open3D, BundleSDF, your own) or of organised clouds (PCD, PLY).
    ROS bag, MCAP, RealSense or Azure Kinect recording; realsense: for a camera that is plugged in."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Run folder to make: model.ply, cloud.ply, trajectory.txt, graph.g2o, report.json, recording.rrd and more."""
    overwrite: bool = False
    """Replace the results of an earlier run in the folder."""
    resume: bool = False
    """Go on with an interrupted run of the same options: pairs that it has registered are not registered again."""
    watch: bool = False
    """Another program is still writing into SEQUENCE: take the frames as they come."""
    idle_s: Annotated[float, tyro.conf.arg(metavar="S")] = 10.0
    """With --watch: the sequence is over when nothing has come for so long (or a file `done` has, or after Ctrl-C)."""
    sensor: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("as SEQUENCE says")] = None
    """Noise of the depth camera, as `modeler calibrate-sensor` measured it."""
    view: bool = False
    """Watch in the Rerun viewer."""
    web: bool = False
    """Watch in the browser, served on 127.0.0.1 only."""
    connect: Annotated[str | None, tyro.conf.arg(metavar="URL"), default("none")] = None
    """Watch in a Rerun viewer that is already open: rerun+http://HOST:PORT/proxy."""
    voxel_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("as the data")] = None
    """Side of a voxel of the model: its detail."""
    prior: PriorOptions = field(default_factory=PriorOptions)
    method: MethodOptions = field(default_factory=MethodOptions)
    selection: FrameOptions = field(default_factory=FrameOptions)
    where: ObjectOptions = field(default_factory=ObjectOptions)

    def run(self) -> int:
        """Build the model; status 3 where it is not to be trusted, as report.json then says."""
        from modeler.cli.building import build

        return build(self)

    def settings(self) -> dict[str, object]:
        """Return what the results depend on besides sequence, seed and the prior's name, as report.json records it."""
        parts = asdict(self.prior) | asdict(self.method) | asdict(self.selection) | asdict(self.where)
        parts["voxel_m"] = self.voxel_m
        parts["sensor"] = None if self.sensor is None else str(self.sensor)
        return {name: value for name, value in parts.items() if name not in ("prior", "seed") and value is not None}
