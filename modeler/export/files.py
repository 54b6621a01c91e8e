"""Files that programs exchange: their text, and how they are written so that no reader sees half of one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler.system.regular_files import left_behind
from modeler.types import Array, Edge, InputError, ObjectModel, Solution

PART = ".part"  # ending of a file that is still being written


def write_atomically(path: Path, content: str | bytes, *, lasting: bool = False, tidy: bool = True) -> None:
    """Write a file atomically: at any moment, also after a kill, the old or the new one is complete.

    A missing folder is created.

    Args:
        path: the file.
        content: all of it.
        lasting: wait until it is on the disk, for safety against power cuts.
        tidy: remove partial files of killed processes, by listing the folder.
    """
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content  # names need not be text
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            for left in left_behind(path, PART) if tidy else ():
                left.unlink(missing_ok=True)
            part.write_bytes(data)
            if lasting:
                settle(part)
            os.replace(part, path)
            if lasting:
                settle(path.parent)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def settle(*paths: Path) -> None:
    """Wait until files, and the names in folders, are on the disk; OSError if one cannot be brought there."""
    for path in paths:
        opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        try:
            os.fsync(opened)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems have no such thing
                raise
        finally:
            os.close(opened)


def settle_soon(*paths: Path) -> threading.Thread:
    """Do so without waiting; files removed by then are ignored."""

    def settled() -> None:
        with contextlib.suppress(OSError):
            settle(*paths)

    thread = threading.Thread(target=settled, daemon=True)
    thread.start()
    return thread


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make a folder, if it is not there, and keep other programs that ask for the same out of it.

    Raises:
        InputError: if it cannot be made, or another program is in it.
    """
    try:
        str(folder).encode()
        folder.mkdir(parents=True, exist_ok=True)
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise InputError(f"{folder}: no run folder can be made ({error.strerror}); choose another place") from error
    except UnicodeEncodeError:
        raise InputError(f"{folder}: its name is not UTF-8; rename it, or choose another place") from None
    try:
        with contextlib.suppress(OSError):  # not every file system has locks
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"{folder}: another run is writing to it; wait until it ends, or choose another place"
                ) from None
        yield
    finally:
        os.close(held)  # which a killed program does, too


def pose_text(pose: Array) -> str:
    """Return `tx ty tz qx qy qz qw` of a pose (4, 4), in m, with every digit that it has and qw not negative."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return " ".join(repr(float(value)) for value in (*pose[:3, 3], *quaternion))


def tum_text(trajectory: Mapping[int, Array], times_s: Mapping[int, float]) -> str:
    """Return one line `timestamp tx ty tz qx qy qz qw` per pose, in order of time.

    Args:
        trajectory: object_from_camera (4, 4) by frame number.
        times_s: time of capture in s by frame number.
    """
    frames = sorted(trajectory, key=lambda frame: (times_s[frame], frame))
    return "".join(f"{float(times_s[frame])!r} {pose_text(trajectory[frame])}\n" for frame in frames)


def g2o_text(edges: Sequence[Edge], solution: Solution) -> str:
    """Return the solved graph as VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines, numbers written in full.

    Vertices are object_from_camera, edges `target source target_from_source` as used: of an edge with several modes,
    the selected one. Information matrices are marginal over the focal length, of translation first, then rotation in
    rad, as g2o orders them and GTSAM reads and writes them. (g2o itself measures rotation by the vector part of a
    quaternion, half the angle: it reads such files, GTSAM's too, with twice the rotation uncertainty.)

    Args:
        edges: those that take part are written: accepted, no outliers, both ends solved.
        solution: the poses.
    """
    lines = [
        f"VERTEX_SE3:QUAT {frame} {pose_text(solution.trajectory[frame])}" for frame in sorted(solution.trajectory)
    ]
    order = [3, 4, 5, 0, 1, 2]  # translation first
    for edge in edges:
        solved = edge.target in solution.trajectory and edge.source in solution.trajectory
        if solved and solution.takes_part(edge):
            pose = solution.pose_of(edge)
            covariance = pose.covariance if solution.focal is None else pose.widened(solution.focal.sigma).covariance
            whitening = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(order, order)]))
            numbers = " ".join(map(repr, (whitening.T @ whitening)[np.triu_indices(6)].tolist()))
            lines.append(f"EDGE_SE3:QUAT {edge.target} {edge.source} {pose_text(pose.mean)} {numbers}")
    return "".join(f"{line}\n" for line in lines)


def cloud_ply(model: ObjectModel) -> bytes:
    """Return the merged cloud of a model as PLY."""
    return ply_bytes(model.points_m, model.normals, model.colours)


def mesh_ply(model: ObjectModel) -> bytes:
    """Return the mesh of a model as PLY; vertices also have `views` and `sigma_m`, if known."""
    return ply_bytes(
        model.vertices_m,
        model.vertex_normals,
        model.vertex_colours,
        model.triangles,
        views=model.vertex_views,
        sigmas_m=model.vertex_sigmas_m,
    )


def ply_bytes(
    points_m: Array,
    normals: Array,
    colours: npt.NDArray[np.uint8] | None = None,
    triangles: npt.NDArray[np.int64] | None = None,
    *,
    views: npt.NDArray[np.int64] | None = None,
    sigmas_m: Array | None = None,
) -> bytes:
    """Return a little-endian PLY file.

    Args:
        points_m: (n, 3); stored as 32-bit floats, 0.06 µm at a distance of 1 m.
        normals: (n, 3) unit vectors.
        colours: (n, 3) RGB.
        triangles: (t, 3) vertex numbers; None: a cloud, without a face element.
        views: (n,) number of views that saw each point, stored as `views`; 0 = interpolated.
        sigmas_m: (n,) standard deviation along the normal, stored as `sigma_m`; inf, stored as -1, where there is none.
    """
    places = np.hstack([points_m, normals]).astype("<f4").T
    columns: dict[str, np.ndarray] = dict(zip(("x", "y", "z", "nx", "ny", "nz"), places, strict=True))
    if colours is not None:
        columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
    if views is not None:
        columns["views"] = np.minimum(views, np.iinfo(np.uint16).max).astype("<u2")
    if sigmas_m is not None:
        columns["sigma_m"] = np.where(np.isfinite(sigmas_m), sigmas_m, -1.0).astype("<f4")  # readers stumble over inf
    fields = [(name, column.dtype) for name, column in columns.items()]
    vertices = np.rec.fromarrays(list(columns.values()), dtype=fields)
    kinds = {"f4": "float", "u1": "uchar", "u2": "ushort"}
    header = [f"property {kinds[kind.str[1:]]} {name}" for name, kind in fields]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *header]
    body = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
        faces["count"], faces["corners"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    return "\n".join([*header, "end_header", ""]).encode() + body
