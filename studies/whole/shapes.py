"""Shapes that no package ships, drawn at random: vessels, lumps, stacks and branched bodies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh

Rng = np.random.Generator


def joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return the triangles of several meshes as one."""
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def vessel(rng: Rng) -> trimesh.Trimesh:
    """Return a jug: a turned profile with a handle and, often, a spout."""
    heights = np.sort(np.concatenate([[0.0, 1.0], rng.uniform(0.1, 0.9, 3)]))
    radii = rng.uniform(0.2, 0.45, 5)
    outer = np.stack([radii, heights], axis=1)
    inner = np.stack([0.85 * radii[::-1], np.maximum(heights[::-1], 0.05)], axis=1)
    profile = np.concatenate([[[0.0, 0.0]], outer, inner, [[0.0, 0.05]]])
    parts = [trimesh.creation.revolve(profile, sections=48)]
    low, high = np.sort(rng.uniform(0.15, 0.9, 2))
    handle = trimesh.creation.torus(max(0.12, 0.5 * (high - low)), rng.uniform(0.02, 0.05))
    handle.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [1.0, 0.0, 0.0]))
    handle.apply_translation([float(np.interp(0.5 * (low + high), heights, radii)), 0.0, 0.5 * (low + high)])
    parts.append(handle)
    if rng.random() < 0.6:
        parts.append(_between([-0.2, 0.0, 0.4], [-0.6, rng.uniform(-0.2, 0.2), rng.uniform(0.7, 1.0)], 0.05))
    return joined(parts)


def lump(rng: Rng) -> trimesh.Trimesh:
    """Return a stone: a sphere under smooth waves of many directions."""
    mesh = trimesh.creation.icosphere(4)
    directions = mesh.vertices
    radii = np.ones(len(directions))
    for wave in range(1, 7):
        axes = rng.normal(size=(3, 3))
        radii += 0.35 / wave * rng.normal() * np.sin(wave * directions @ axes.T + rng.uniform(0.0, 6.3, 3)).mean(axis=1)
    mesh.vertices = directions * np.maximum(radii, 0.2)[:, None] * rng.uniform(0.5, 1.0, 3)
    return mesh


def stack(rng: Rng) -> trimesh.Trimesh:
    """Return boxes and cylinders grown into one another: appliances, tools and toys of wood."""
    parts, centres = [], [np.zeros(3)]
    for _ in range(int(rng.integers(3, 8))):
        centre = centres[int(rng.integers(len(centres)))] + rng.normal(0.0, 0.2, 3)
        size = rng.uniform(0.25, 0.8, 3)
        part = (
            trimesh.creation.box(size)
            if rng.random() < 0.6
            else trimesh.creation.cylinder(0.4 * size[0], 1.2 * size[1])
        )
        turn = rng.choice([0.0, 0.5 * np.pi, rng.uniform(0.0, np.pi)])
        part.apply_transform(trimesh.transformations.rotation_matrix(turn, rng.permutation([1.0, 0.0, 0.0])))
        part.apply_translation(centre)
        parts.append(part)
        centres.append(centre)
    return joined(parts)


def branched(rng: Rng) -> trimesh.Trimesh:
    """Return a trunk with limbs, each of which may fork: figures, coat stands and plants without leaves."""
    ends = [(np.zeros(3), np.array([0.0, 0.0, rng.uniform(0.4, 0.8)]))]
    parts = [_between(*ends[0], rng.uniform(0.05, 0.15)), trimesh.creation.cylinder(rng.uniform(0.15, 0.3), 0.06)]
    for _ in range(int(rng.integers(3, 9))):
        start, end = ends[int(rng.integers(len(ends)))]
        foot = start + rng.uniform(0.3, 1.0) * (end - start)
        tip = foot + rng.normal(0.0, 0.3, 3) + [0.0, 0.0, 0.15]
        parts.append(_between(foot, tip, rng.uniform(0.025, 0.1)))
        ends.append((foot, tip))
    tip = ends[0][1]
    ball = trimesh.creation.icosphere(3, rng.uniform(0.1, 0.25))
    ball.apply_translation(tip)
    return joined([*parts, ball])


def _between(start: npt.ArrayLike, end: npt.ArrayLike, radius: float) -> trimesh.Trimesh:
    """Return a capsule from one point to another."""
    first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = float(np.linalg.norm(last - first))
    pose = np.asarray(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], (last - first) / length), np.float64)
    pose[:3, 3] = 0.5 * (first + last)
    return trimesh.creation.capsule(length, radius, transform=pose)


KINDS: Final[Mapping[str, Callable[[Rng], trimesh.Trimesh]]] = MappingProxyType(
    {"vessel": vessel, "lump": lump, "stack": stack, "branched": branched}
)
"""By name."""
