"""Writers of clouds: PCD and PLY."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from modeler.types import Frame


@dataclass(frozen=True, eq=False)
class Layout:
    """What a program makes of a camera's points."""

    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Rotation (3, 3) from camera coordinates into those of the file."""
    organised: bool = True
    """Whether there is a point a pixel; else only what was measured."""


AS_SEEN = Layout()


def points_of(frame: Frame) -> np.ndarray:
    w, h = frame.camera.rays()
    return (np.stack([w, h, np.ones_like(w)], axis=2) * frame.depth_m[..., None]).astype("<f4")


def table(frame: Frame, names: str, kinds: list[str], layout: Layout) -> np.ndarray:
    points, colour = points_of(frame).reshape(-1, 3) @ layout.axes.T.astype("<f4"), frame.colour
    assert colour is not None
    rows = np.zeros(len(points), dtype=list(zip(names.split(), kinds, strict=True)))
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    flat = colour.reshape(-1, 3).astype(np.uint32)
    if "rgb" in names.split():  # as the Point Cloud Library packs it
        rows["rgb"] = (flat[:, 0] << 16) | (flat[:, 1] << 8) | flat[:, 2]
    else:
        for axis, name in enumerate(("red", "green", "blue")):
            rows[name] = flat[:, axis]
    return rows if layout.organised else rows[np.isfinite(points).all(axis=1)]


def write_pcd(path: Path, frame: Frame, data: str, layout: Layout = AS_SEEN) -> None:
    rows = table(frame, "x y z rgb", ["<f4", "<f4", "<f4", "<u4"], layout)
    height, width = frame.depth_m.shape if layout.organised else (1, len(rows))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {width * height}\nDATA {data}\n"
    )
    if data == "ascii":
        lines = (f"{r['x']!s} {r['y']!s} {r['z']!s} {np.uint32(r['rgb']).view(np.float32)!s}\n" for r in rows)
        body = "".join(lines).encode()
    elif data == "binary":
        body = rows.tobytes()
    else:  # the library's LZF, all of it literal
        columns = b"".join(rows[name].tobytes() for name in ("x", "y", "z", "rgb"))
        packed = b"".join(
            bytes([len(columns[at : at + 32]) - 1]) + columns[at : at + 32] for at in range(0, len(columns), 32)
        )
        body = np.array([len(packed), len(columns)], "<u4").tobytes() + packed
    path.write_bytes(header.encode() + body)


def write_ply(
    path: Path,
    frame: Frame,
    data: str = "binary_little_endian",
    size: str = "obj_info num_",
    layout: Layout = AS_SEEN,
) -> None:
    rows = table(frame, "x y z red green blue", ["<f4"] * 3 + ["u1"] * 3, layout)
    height, width = frame.depth_m.shape
    header = [
        "ply",
        f"format {data} 1.0",
        *([f"{size}cols {width}", f"{size}rows {height}"] if layout.organised else []),
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header\n",
    ]
    body = rows.tobytes() if data != "ascii" else "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    path.write_bytes("\n".join(header).encode() + body)


WRITERS: dict[str, tuple[str, Callable[..., None]]] = {
    "pcd ascii": (".pcd", lambda path, frame, layout=AS_SEEN: write_pcd(path, frame, "ascii", layout)),
    "pcd binary": (".pcd", lambda path, frame, layout=AS_SEEN: write_pcd(path, frame, "binary", layout)),
    "pcd compressed": (".pcd", lambda path, frame, layout=AS_SEEN: write_pcd(path, frame, "binary_compressed", layout)),
    "ply binary": (".ply", lambda path, frame, layout=AS_SEEN: write_ply(path, frame, layout=layout)),
    "ply ascii": (".ply", lambda path, frame, layout=AS_SEEN: write_ply(path, frame, "ascii", "comment ", layout)),
}
