"""A run made up for tests of what runs leave on disk."""

import json
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from modeler import se3
from modeler.export import RunMeta
from modeler.graph import PoseGraph, solve
from modeler.types import (
    Array,
    Camera,
    Edge,
    EdgeKind,
    Frame,
    FrameRecord,
    ObjectModel,
    Outcome,
    PoseGaussian,
    Posterior,
    RayImage,
    Segmentation,
    Stated,
    Step,
)

META = RunMeta(sequence="box", seed=3, prior="table", settings={"every": 1}, seconds={"total": 1.5})


def ball(*, coloured: bool = True) -> ObjectModel:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    normals = np.asarray(ball.vertices / 0.05)
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, size=(len(normals), 3), dtype=np.uint8) if coloured else None
    cloud = np.asarray(ball.vertices) + np.array([0.0, 0.0, 0.8])
    return ObjectModel(cloud[::2], normals[::2], None if colours is None else colours[::2], cloud,
                       np.asarray(ball.faces, dtype=np.int64), normals, colours)  # fmt: skip


def model_of(mesh: trimesh.Trimesh) -> ObjectModel:
    """A mesh as the surface of a model, without colours and points of views."""
    none = np.zeros((0, 3))
    vertices_m, normals = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.vertex_normals, np.float64)
    return ObjectModel(none, none, None, vertices_m, np.asarray(mesh.faces, np.int64), normals, None)


def block(sides_m: tuple[float, float, float], pose: Array) -> ObjectModel:
    """A solid box about the origin of a frame, given by its pose (4, 4)."""
    return model_of(trimesh.creation.box(sides_m, pose))


def an_edge(target: int, source: int, rng: np.random.Generator, kind: EdgeKind = "odometry", **changes: Any) -> Edge:
    step = (source - target) * np.array([0.01, 0.4, 0.005, -0.3, 0.0, 0.025])
    factor = rng.normal(size=(6, 6)) * 0.0002 + 0.0003 * np.eye(6)
    pose = PoseGaussian(se3.exp(step + 0.0002 * rng.normal(size=6)), factor @ factor.T)
    posterior = Posterior(source, target, pose, Outcome.CONVERGED, overlap=0.81, effective_samples=1234.5)
    return Edge(replace(posterior, **changes), kind, True, Stated("made up"))


def made_up_steps(count: int = 4, *, closure: bool = True) -> list[Step]:
    """A run of `count` frames numbered 3, 5, 7 …"""
    rng = np.random.default_rng(1)
    camera = Camera(4, 3, 500.0, 500.0, 1.5, 1.0)
    graph, views, steps = PoseGraph(first=3), {}, []
    for number in range(count):
        index, last = 3 + 2 * number, number == count - 1
        frame = Frame(index, 0.1 * index, np.full((3, 4), 0.8, dtype=np.float32), camera)
        pixels = np.zeros((5, 2), dtype=np.int64)
        view = RayImage(frame, None, 0.001, 0.0025, np.ones((5, 3)), np.ones((5, 3)), pixels)
        edges = [an_edge(index - 2, index, rng)] if number else []
        if last and closure:
            edges.append(an_edge(3, index, rng, "closure"))
        graph, views = graph.plus(edges), {**views, index: view}
        steps.append(
            Step(
                frame=frame,
                segmentation=Segmentation(np.ones((3, 4), dtype=bool), None, Outcome.CONVERGED),
                view=view,
                posteriors=tuple(edge.posterior for edge in edges),
                edges=tuple(edges),
                left_out=None,
                solution=solve(graph, {}),
                make_model=ball,
                edges_so_far=graph.edges,
                views=views,
                last=last,
            )
        )
    return with_records(steps)


def with_records(steps: Iterable[Step]) -> list[Step]:
    """Return the steps of a run with the results of the frames before each."""
    records: dict[int, FrameRecord] = {}
    found = []
    for step in steps:
        records[step.frame.index] = step.record
        found.append(replace(step, frames_so_far=tuple(records.values())))
    return found


def strict_json(text: str) -> Any:
    """Parse JSON as the standard has it: no NaN, no Infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)
