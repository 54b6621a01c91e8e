"""What is fuzzed: a small intact input of each format, and the files of it that are damaged."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image
from rosbags import rosbag1, rosbag2

from modeler import se3, sequences
from modeler.cli import main
from modeler.cli.convert import Convert
from modeler.export import RunFolder, edges_of, poses_of
from modeler.runs.reopening import solved
from modeler.sequences import open_sequence, read_noise, survey, write_bop
from modeler.sequences.rendering.recipe import load_recipe
from modeler.sequences.tum import trajectory
from modeler.types import Camera, Frame, InputError
from studies.formats import clouds, image_folders, kinect, recorded, ros_bags
from studies.fuzz.special import remove


@dataclass(frozen=True)
class Target:
    """One format."""

    make: Callable[[Path], Path]
    """Writes an intact input into a folder and returns its path."""
    damage: tuple[str, ...]
    """Patterns, relative to the folder, of the files to damage, one at a time."""
    read: Callable[[Path], object]
    """Reads all of it."""
    share: float = 1.0
    """How many inputs to try, relative to the others."""


def tiny(count: int = 2) -> list[Frame]:
    """Return frames of 24 x 16 pixels."""
    rng = np.random.default_rng(0)
    camera = Camera(24, 16, 30.0, 30.5, 11.5, 7.5)
    frames = []
    for index in range(count):
        depth_m = np.rint(rng.uniform(500.0, 1500.0, (16, 24))).astype(np.float32) * np.float32(0.001)
        depth_m[rng.random(depth_m.shape) < 0.1] = np.nan
        colour = rng.integers(0, 256, (16, 24, 3), dtype=np.uint8)
        frames.append(Frame(index, 0.1 * index, depth_m, camera, depth_m < 1.0, colour))
    return frames


def truth(count: int = 2) -> dict[int, np.ndarray]:
    rng = np.random.default_rng(1)
    return {index: se3.exp(0.3 * rng.normal(size=6)) for index in range(count)}


def read_all(path: Path) -> object:
    """Read every frame and the truth; what `info` computes of them (`inspect`) takes twenty times as long."""
    sequence = open_sequence(path)
    for index in sequence.indices:
        sequence.frame(index)
    return sequence.truth(), sequence.sensor(), sequence.motion, sequence.notes


def inspect(path: Path) -> object:
    """Read every frame and the truth, and look at them as `info` does."""
    return survey(open_sequence(path))


def _bop(folder: Path) -> Path:
    meta = {
        "name": "s",
        "sensor": {"sigma_wh": 1e-3, "sigma_r_m": 2e-3},
        "motion": {"kind": "table", "step_deg": 25, "sigma_deg": 3},
    }
    write_bop(folder / "s", tiny(), truth(), meta, colour_suffix=".jpg")
    return folder / "s"


def _tiff(folder: Path) -> Path:
    path = _bop(folder)
    for frame in tiny():
        (path / "depth" / f"{frame.index:06d}.png").unlink()
        image_folders.save(path / "depth" / f"{frame.index:06d}.tif", image_folders.raw_depth(frame, 0.1))
    return path


def _written(write: Callable[[Path, list[Frame], dict[int, np.ndarray]], None]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(folder / "s", tiny(), truth())
        return folder / "s"

    return make


def _bag(name: str, recorder: ros_bags.Recorder) -> Callable[[Path], Path]:
    return lambda folder: recorder.write(folder / name, tiny())


def _cloud(kind: str) -> Callable[[Path], Path]:
    suffix, write = clouds.WRITERS[kind]

    def make(folder: Path) -> Path:
        smooth = replace(tiny()[0], depth_m=np.full((16, 24), 0.8, np.float32))
        write(folder / f"s{suffix}", smooth)
        return folder / f"s{suffix}"

    return make


def _kinect(folder: Path) -> Path:
    kinect.write_mkv(folder / "s.mkv", 2)
    return folder / "s.mkv"


def _recorded(name: str) -> Callable[[Path], Path]:
    """Return what puts a recording of a camera's own library into a folder."""
    return lambda folder: recorded.unpacked(name, folder)


def _noise(folder: Path) -> Path:
    noise = {"lateral_px": 0.5, "focal_px": 500.0, "floor_m": 1e-4, "growth": [1e-6, 1e-7, 0.0]}
    (folder / "s.json").write_text(json.dumps({"noise": noise}))
    return folder / "s.json"


TARGETS: dict[str, Target] = {
    "bop": Target(_bop, ("s/*.json",), read_all, 2.0),
    "png": Target(_bop, ("s/depth/*", "s/mask_visib/*"), read_all, 2.0),
    "info": Target(_bop, ("s/depth/*", "s/mask_visib/*", "s/*.json"), inspect, 0.2),
    "jpg": Target(_bop, ("s/rgb/*",), read_all),
    "tiff": Target(_tiff, ("s/depth/*",), read_all),
    "tum": Target(_written(image_folders.write_tum), ("s/*.txt",), read_all, 2.0),
    "open3d": Target(_written(image_folders.write_open3d), ("s/*.json", "s/*.log"), read_all, 2.0),
    "bundlesdf": Target(_written(image_folders.write_bundlesdf), ("s/*.txt", "s/annotated_poses/*"), read_all, 2.0),
    "ros1": Target(_bag("s.bag", ros_bags.Recorder()), ("s.bag",), read_all, 2.0),
    "ros1 packed": Target(
        _bag("s.bag", ros_bags.Recorder("compressedDepth", "jpeg", compression=rosbag1.Writer.CompressionFormat.LZ4)),
        ("s.bag",),
        read_all,
    ),
    "mcap of ros1": Target(_bag("s.mcap", ros_bags.Recorder(ros1=True)), ("s.mcap",), read_all),
    "ros1 fixed": Target(_bag("s.bag", ros_bags.Rig(colour_scale=1.1)), ("s.bag",), read_all),
    "realsense": Target(
        _bag("s.bag", ros_bags.OldRealSense("mono16", "rgb8", names=ros_bags.NAMES, colour_scale=1.1)),
        ("s.bag",),
        read_all,
    ),
    "mcap": Target(_bag("s.mcap", ros_bags.Recorder("32FC1", "bgr8")), ("s.mcap",), read_all, 2.0),
    "db3": Target(_bag("s.db3", ros_bags.Recorder()), ("s.db3",), read_all),
    "ros2 folder": Target(_bag("s", ros_bags.Recorder()), ("s/metadata.yaml",), read_all, 0.3),
    "pcd": Target(_cloud("pcd binary"), ("s.pcd",), read_all),
    "pcd ascii": Target(_cloud("pcd ascii"), ("s.pcd",), read_all),
    "pcd packed": Target(_cloud("pcd compressed"), ("s.pcd",), read_all),
    "ply": Target(_cloud("ply binary"), ("s.ply",), read_all),
    "noise": Target(_noise, ("s.json",), read_noise),
}


def _packed(mode: rosbag2.CompressionMode) -> Callable[[Path], Path]:
    return _bag("s", ros_bags.Recorder(packed=mode))


def _tum_pairs(folder: Path) -> Path:
    """Write lists of which times and paths must be told apart from each other: many pictures, masks, no order."""
    image_folders.write_tum(folder / "s", tiny(6), truth(6))
    for picture in sorted((folder / "s" / "depth").iterdir())[::2]:
        image_folders.save(folder / "s" / "mask" / picture.name, np.full((16, 24), 255, np.uint8))
    return folder / "s"


def _intrinsics(name: str, content: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        image_folders.write_open3d(folder / "s", tiny(), truth())
        (folder / "s" / "camera_intrinsic.json").unlink()
        (folder / "s" / name).write_text(content)
        return folder / "s"

    return make


def _listed(folder: Path) -> Path:
    """Write a folder of nerfstudio, each camera on its own."""
    shots = []
    for frame in tiny():
        image_folders.save(folder / "s" / "depth" / f"{frame.index}.png", image_folders.raw_depth(frame, 1.0))
        assert frame.colour is not None
        image_folders.save(folder / "s" / "images" / f"{frame.index}.png", frame.colour)
        paths = {"file_path": f"images/{frame.index}.png", "depth_file_path": f"depth/{frame.index}.png"}
        camera = {"fl_x": 30.0 + frame.index, "fl_y": 30.5, "cx": 12.0, "cy": 8.0}
        shots.append(paths | camera | {"transform_matrix": np.eye(4).tolist()})
    lens = {"w": 24, "h": 16, "camera_model": "OPENCV", "k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    (folder / "s" / "transforms.json").write_text(json.dumps(lens | {"frames": shots}))
    return folder / "s"


def _record3d(folder: Path) -> Path:
    lzfse = importlib.import_module("lzfse")
    meta = {"K": [30, 0, 0, 0, 30, 0, 12, 8, 1], "w": 24, "h": 16, "dw": 24, "dh": 16, "fps": 60}
    with zipfile.ZipFile(folder / "s.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(meta | {"frameTimestamps": [7.0, 7.5]}))
        for frame in tiny():
            assert frame.colour is not None
            packed = io.BytesIO()
            Image.fromarray(frame.colour).save(packed, "JPEG")
            archive.writestr(f"rgbd/{frame.index}.depth", lzfse.compress(frame.depth_m.astype("<f4").tobytes()))
            archive.writestr(f"rgbd/{frame.index}.conf", lzfse.compress(np.full((16, 24), 2, np.uint8).tobytes()))
            archive.writestr(f"rgbd/{frame.index}.jpg", packed.getvalue())
    return folder / "s.r3d"


def _stray(folder: Path) -> Path:
    for frame in tiny():
        image_folders.save(folder / "s" / "depth" / f"{frame.index}.png", image_folders.raw_depth(frame, 1.0))
        image_folders.save(folder / "s" / "confidence" / f"{frame.index}.png", np.full((16, 24), 2, np.uint8))
    (folder / "s" / "camera_matrix.csv").write_text("30.0, 0.0, 12.0\n0.0, 30.0, 8.0\n0.0, 0.0, 1.0\n")
    return folder / "s"


def _depth_as(suffix: str) -> Callable[[Path], Path]:
    """Return what writes depth in m, or of PGM in mm, as files of a kind."""

    def make(folder: Path) -> Path:
        inner = folder / "s" / "depth"
        inner.mkdir(parents=True)
        for frame in tiny():
            path, depth_m = inner / f"{frame.index}{suffix}", np.nan_to_num(frame.depth_m)
            match suffix:
                case ".npy":
                    np.save(path, depth_m)
                case ".npz":
                    np.savez_compressed(path, depth=depth_m)
                case ".exr":
                    openexr = importlib.import_module("OpenEXR")
                    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
                    openexr.File(header, {"Z": depth_m}).write(str(path))
                case _:
                    pixels = np.rint(1000.0 * depth_m).astype(">u2").tobytes()
                    path.write_bytes(b"P5\n24 16\n65535\n" + pixels)
        (folder / "s" / "camera.json").write_text('{"fx": 30, "fy": 30.5, "cx": 11.5, "cy": 7.5}')
        return folder / "s"

    return make


_OPENCV: Final = """%YAML:1.0
---
image_width: 24
image_height: 16
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [30., 0., 11.5, 0., 30.5, 7.5, 0., 0., 1.]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [0.1, -0.02, 0.001, 0.002, 0.]
"""
_CAMERA_INFO: Final = """width: 24
height: 16
distortion_model: plumb_bob
d: [0.1, -0.02, 0.001, 0.002, 0.0]
k: [30.0, 0.0, 11.5, 0.0, 30.5, 7.5, 0.0, 0.0, 1.0]
"""


def _robot(folder: Path) -> Path:
    rows = (f"{0.1 * k} {0.01 * k} 0.2 -0.3 0 0 {np.sin(0.1 * k)} {np.cos(0.1 * k)}" for k in range(9))
    (folder / "robot.txt").write_text("# time tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    return folder / "robot.txt"


def _recipe(folder: Path) -> Path:
    shutil.copy(Path(sequences.__file__).parent / "recipes" / "figurine.json", folder / "s.json")
    return folder / "s.json"


def _report(folder: Path) -> Path:
    """Write a report with all that other commands rely on."""
    gaussian = {"target_from_source": np.eye(4).ravel().tolist(), "covariance": (1e-4 * np.eye(6)).ravel().tolist()}
    numbers = dict.fromkeys(("overlap", "effective_samples", "pareto_k", "log_evidence", "seconds"), 0.5)
    edges = [
        {
            "source": k + 1,
            "target": k,
            "kind": "odometry",
            "accepted": True,
            "outcome": "converged",
        }
        | gaussian
        | numbers
        | {"modes": [gaussian | {"weight": 0.6}, gaussian | {"weight": 0.4}]}
        for k in range(2)
    ]
    pose = {"object_from_camera": np.eye(4).ravel().tolist(), "covariance": np.eye(6).ravel().tolist()}
    report: dict[str, object] = {
        "schema": 1,
        "frames": [{"id": k, "timestamp": 0.1 * k, "points": 9, "outcome": "accepted"} for k in range(3)],
        "poses": [{"id": k, **pose} for k in range(3)],
    }
    report |= {"sequence": "s", "seed": 0, "prior": "table", "edges": edges}
    report |= {"closed": False, "trustworthy": True, "reasons": ["none"], "seconds": {"total": 1.5}}
    report["settings"] = {"roi": [0, 0, 9, 9], "max_depth_m": 2.0, "voxel_m": 0.002, "frames": ":"}
    (folder / "report.json").write_text(json.dumps(report))
    return folder


def _reopen(path: Path) -> None:
    report = RunFolder(path).result()
    solved(edges_of(report), {frame: pose.mean for frame, pose in poses_of(report).items()}, {}, report.get("camera"))


def _poses(path: Path) -> None:
    Convert(path, path.parent / "poses.json", overwrite=True).run()


def _runs(folder: Path) -> Path:
    """Write a sequence and two runs of it."""
    write_bop(folder / "s", image_folders.small_frames(3), image_folders.small_truth(3), depth_scale_mm=1.0)
    for name in ("a", "b"):
        arguments = ["build", str(folder / "s"), "--out", str(folder / name), "--prior", "table", "--method", "icp"]
        with contextlib.redirect_stderr(io.StringIO()):
            main(arguments)
    return folder


def _command(*arguments: str) -> Callable[[Path], None]:
    """Return what runs a command; names that begin with @ are those of files in the folder of the input."""

    def run(folder: Path) -> None:
        for made in folder.glob("out*"):
            remove(made)
        said = io.StringIO()
        placed = [str(folder / argument[1:]) if argument.startswith("@") else argument for argument in arguments]
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            status = main(placed)
        last = said.getvalue().rstrip("\n").rpartition("\n")[2]
        if status == 2:
            raise InputError(last)
        assert status in (0, 3), f"status {status}: {said.getvalue()}"

    return run


_MODES = rosbag2.CompressionMode
TARGETS |= {
    "mcap packed": Target(_packed(_MODES.STORAGE), ("s/*.mcap",), read_all, 2.0),
    "ros2 messages": Target(_packed(_MODES.MESSAGE), ("s/*.mcap", "s/metadata.yaml"), read_all),
    "ros2 files": Target(_packed(_MODES.FILE), ("s/*.zstd", "s/metadata.yaml"), read_all, 0.5),
    "mcap fixed": Target(_bag("s.mcap", ros_bags.Rig(colour_scale=1.1)), ("s.mcap",), read_all),
    "tum pairs": Target(_tum_pairs, ("s/*.txt",), read_all, 2.0),
    "ply ascii": Target(_cloud("ply ascii"), ("s.ply",), read_all),
    "named": Target(
        _intrinsics("intrinsics.json", '{"intrinsic": {"fx": 30, "fy": 30.5, "ppx": 11.5, "ppy": 7.5}}'),
        ("s/*.json",),
        read_all,
    ),
    "nested": Target(
        _intrinsics("camera.json", '{"K": [[30, 0, 11.5], [0, 30.5, 7.5], [0, 0, 1]]}'), ("s/*.json",), read_all
    ),
    "plain": Target(_intrinsics("intrinsics.txt", "30 30.5 11.5 7.5\n"), ("s/*.txt",), read_all, 0.5),
    "opencv": Target(_intrinsics("camera.yaml", _OPENCV), ("s/*.yaml",), read_all),
    "camera_info": Target(_intrinsics("camera_info.yaml", _CAMERA_INFO), ("s/*.yaml",), read_all),
    "nerfstudio": Target(_listed, ("s/transforms.json",), read_all, 2.0),
    "stray scanner": Target(_stray, ("s/camera_matrix.csv", "s/confidence/*"), read_all),
    "npy": Target(_depth_as(".npy"), ("s/depth/*",), read_all),
    "npz": Target(_depth_as(".npz"), ("s/depth/*",), read_all),
    "exr": Target(_depth_as(".exr"), ("s/depth/*",), read_all),
    "pgm": Target(_depth_as(".pgm"), ("s/depth/*",), read_all),
    "robot": Target(_robot, ("robot.txt",), trajectory),
    "recipe": Target(_recipe, ("s.json",), load_recipe),
    "run": Target(_report, ("report.json",), _poses),
    "report": Target(_report, ("report.json",), _reopen),
    "export": Target(_runs, ("a/model.ply", "a/report.json"), _command("export", "@a", "--out", "@out.obj"), 0.3),
    "export anew": Target(
        _runs, ("a/report.json",), _command("export", "@a", "--out", "@out.obj", "--voxel-m", "0.01"), 0.1
    ),
    "export for a simulator": Target(
        _runs,
        ("a/model.ply", "a/report.json"),
        _command("export", "@a", "--for", "mujoco", "--out", "@out"),
        0.02,
    ),
    "page": Target(_runs, ("a/report.json", "a/recording.rrd"), _command("report", "@a", "--out", "@out.html"), 0.1),
    "join": Target(_runs, ("a/report.json", "b/report.json"), _command("join", "@a", "@b", "--out", "@out"), 0.1),
    "resume": Target(
        _runs,
        ("a/report.json",),
        _command("build", "@s", "--out", "@a", "--resume", "--prior", "table", "--method", "icp"),
        0.1,
    ),
    "realsense 2.56": Target(_recorded("realsense-2.56.bag"), ("*.bag",), read_all, 0.5),
    "realsense 2.58": Target(_recorded("realsense-2.58.db3"), ("*.db3",), read_all),
    "foxglove": Target(_recorded("foxglove.mcap"), ("*.mcap",), read_all),
    "realsense 2.59": Target(_recorded("realsense-2.59.db3"), ("*.db3",), read_all),
    "realsense 2.59 yuyv": Target(_recorded("realsense-2.59-yuyv.db3"), ("*.db3",), read_all),
}
if importlib.util.find_spec("lzfse") is not None:
    TARGETS["record3d"] = Target(_record3d, ("s.r3d",), read_all)
if importlib.util.find_spec("av") is not None:
    TARGETS["mkv"] = Target(_kinect, ("s.mkv",), read_all, 0.5)
    TARGETS["k4arecord"] = Target(_recorded("kinect.mkv"), ("kinect.mkv",), read_all, 0.3)


def fresh(target: Target, folder: Path) -> tuple[Path, list[Path]]:
    """Write an intact input and return its path and the files to damage."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = target.make(folder)
    return path, sorted(file for pattern in target.damage for file in folder.glob(pattern))
