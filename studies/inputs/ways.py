"""The ways in which people save a recording, right and wrong; each draws its kind, format, names and numbers."""

from __future__ import annotations

import importlib
import importlib.util
import json
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image
from rosbags import rosbag1, rosbag2
from scipy import ndimage

from modeler.types import Camera, Frame
from studies.formats import clouds
from studies.formats.image_folders import WRITERS, raw_depth, save
from studies.formats.other_programs import CAMERAS, DEPTHS, NAMES, distorted, write_camera
from studies.formats.ros_bags import Recorder

Rng = np.random.Generator


@dataclass(frozen=True)
class Given:
    """What is handed over, and what should come of it."""

    said: str
    """What was drawn, in words."""
    cause: str = ""
    """Pattern of the words that name what is wrong with it; "": nothing is, it must be read and modelled right."""
    options: tuple[str, ...] = ()
    """Of the build."""
    commands: tuple[tuple[str, ...], ...] = ()
    """Those before; `{in}` is the folder of the input, `{out}` that of the runs."""
    last: tuple[str, ...] = ("build", "{in}/s", "--out", "{out}/run")
    """The command that is judged."""
    shown: tuple[int, ...] | None = None
    """Frame numbers of the scene in the order of the input; None: all."""
    later: Callable[[], None] | None = None
    """What happens before the last command."""


Way = Callable[[Path, Sequence[Frame], Rng], Given]


def _pick(rng: Rng, names: Sequence[str]) -> str:
    return str(rng.choice(list(names)))


def _colour(frame: Frame) -> np.ndarray:
    assert frame.colour is not None
    return frame.colour


def _mask(frame: Frame) -> np.ndarray:
    assert frame.mask is not None
    return frame.mask


def _plain(folder: Path, frames: Sequence[Frame], unit_mm: float = 0.1, **more: object) -> Path:
    """Write depth, colour and intrinsics in the simplest way."""
    for frame in frames:
        save(folder / "s" / "depth" / f"{frame.index:03d}.png", raw_depth(frame, unit_mm))
        save(folder / "s" / "rgb" / f"{frame.index:03d}.png", _colour(frame))
    write_camera(folder / "s", frames[0].camera, depth_scale=unit_mm, **more)
    return folder / "s"


def formats(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """A format of depth that other programs write, by name of format and unit."""
    kind = _pick(rng, [*DEPTHS])
    write, units = DEPTHS[kind]
    (folder / "s" / "depth").mkdir(parents=True)
    for frame in frames:
        depth = (np.nan_to_num(frame.depth_m) * np.float32(units)).astype(np.float32)
        write(folder / "s" / "depth" / f"{frame.index}.{kind.split()[0]}", depth)
        save(folder / "s" / "rgb" / f"{frame.index}.jpg", _colour(frame))
    write_camera(folder / "s", frames[0].camera)
    return Given(kind)


def names(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Names that say what an image shows, from any number on."""
    kind, first = _pick(rng, [*NAMES]), int(rng.integers(0, 120))
    depth, colour, mask = NAMES[kind]
    for frame in frames:
        number = first + frame.index, 636000000000000000 + 5000000 * frame.index
        save(folder / "s" / depth.format(*number), raw_depth(frame, 1.0))
        if colour is not None:
            save(folder / "s" / colour.format(*number), _colour(frame))
        if mask is not None and rng.random() < 0.5:
            save(folder / "s" / mask.format(*number), _mask(frame).astype(np.uint8) * 255)
    write_camera(folder / "s", frames[0].camera)
    return Given(f"{kind} from {first}")


def layouts(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """A folder of another program: TUM, Open3D, BundleSDF, nerfstudio, Stray Scanner, Record3D."""
    phones = ("nerfstudio", "Stray Scanner", *(["Record3D"] if importlib.util.find_spec("lzfse") else []))
    kind = _pick(rng, (*WRITERS, *phones))
    factor = int(rng.integers(1, 5))
    camera, path = frames[0].camera, folder / "s"
    large = {"fx": factor * camera.fx, "fy": factor * camera.fy}
    large |= {"cx": factor * (camera.cx + 0.5) - 0.5, "cy": factor * (camera.cy + 0.5) - 0.5}
    size = factor * camera.width, factor * camera.height
    if kind in WRITERS:
        WRITERS[kind](path, list(frames), None)
        return Given(kind)
    if kind == "Record3D":
        return replace(_record3d(folder, frames, size, large), said=f"Record3D, colour {factor} times as large")
    listed = []
    for frame in frames:
        depth, image = f"depth/{frame.index:06d}.png", f"rgb/{frame.index:06d}.jpg"
        save(path / depth, raw_depth(frame, 1.0))
        save(path / image, np.asarray(Image.fromarray(_colour(frame)).resize(size)))
        save(path / "confidence" / f"{frame.index:06d}.png", np.full(frame.depth_m.shape, 2, np.uint8))
        listed.append({"file_path": image, "depth_file_path": depth, "transform_matrix": np.eye(4).tolist()})
    if kind == "nerfstudio":
        facts = {"fl_x": large["fx"], "fl_y": large["fy"], "cx": large["cx"] + 0.5, "cy": large["cy"] + 0.5}
        facts |= {"w": size[0], "h": size[1], "frames": listed}
        (path / "transforms.json").write_text(json.dumps(facts))
    else:
        rows = f"{large['fx']}, 0, {large['cx']}\n0, {large['fy']}, {large['cy']}\n0, 0, 1\n"
        (path / "camera_matrix.csv").write_text(rows)
    return Given(f"{kind}, colour {factor} times as large")


def _record3d(folder: Path, frames: Sequence[Frame], size: tuple[int, int], large: Mapping[str, float]) -> Given:
    lzfse = importlib.import_module("lzfse")
    meta = {"K": [large["fx"], 0, 0, 0, large["fy"], 0, large["cx"], large["cy"], 1], "w": size[0], "h": size[1]}
    meta |= {"dw": frames[0].camera.width, "dh": frames[0].camera.height, "fps": 60}
    with zipfile.ZipFile(folder / "s.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(meta))
        for frame in frames:
            archive.writestr(f"rgbd/{frame.index}.depth", lzfse.compress(frame.depth_m.astype("<f4").tobytes()))
            with archive.open(f"rgbd/{frame.index}.jpg", "w") as file:
                Image.fromarray(_colour(frame)).resize(size).save(file, "JPEG", quality=92)
    return Given("", last=("build", "{in}/s.r3d", "--out", "{out}/run"))


def lenses(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """A lens beside the intrinsics, in a file of any program."""
    name, text = CAMERAS[kind := _pick(rng, [*CAMERAS])]
    lens = [
        float(rng.uniform(-0.3, 0.12)),
        float(rng.uniform(-0.02, 0.09)),
        *(float(x) for x in rng.normal(0, 1e-3, 2)),
    ]
    lens.append(0.0)
    camera = frames[0].camera
    for frame in frames:
        bent = distorted(raw_depth(frame, 1.0), camera, lens)
        save(folder / "s" / "depth" / f"{frame.index:03d}.png", bent)
        channels = [distorted(_colour(frame)[..., channel], camera, lens, order=1) for channel in range(3)]
        save(folder / "s" / "rgb" / f"{frame.index:03d}.png", np.stack(channels, axis=2))
    (folder / "s" / name).write_text(text(camera, lens))
    return Given(f"{kind}, k1 {lens[0]:.2f}, k2 {lens[1]:.2f}")


def angles(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Files that are named by the angle of a turntable."""
    step = 24
    for frame in frames:
        save(folder / "s" / "depth" / f"{step * frame.index}.png", raw_depth(frame, 0.1))
        save(folder / "s" / "rgb" / f"{step * frame.index}.png", _colour(frame))
    write_camera(folder / "s", frames[0].camera, depth_scale=0.1)
    return Given("by angle", cause="angle|--step-deg 1")


def along_ray(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Distances along the ray, as renderers write them."""
    w, h = frames[0].camera.rays()
    length = np.sqrt(1.0 + np.square(w) + np.square(h)).astype(np.float32)
    _plain(folder, [replace(frame, depth_m=frame.depth_m * length) for frame in frames])
    return Given("", cause="along the ray")


def other_camera(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Colour of another camera, resized to depth's size."""
    factor = float(rng.uniform(1.08, 1.4)) if rng.random() < 0.7 else 1.0
    least = 8.0 if factor == 1.0 else 0.0
    off_px = rng.uniform(least, 20.0, 2) * rng.choice([-1.0, 1.0], 2)
    height, width = frames[0].depth_m.shape

    def seen(frame: Frame) -> Frame:
        middle = width / 2 * (1 - 1 / factor) + off_px[0], height / 2 * (1 - 1 / factor) + off_px[1]
        affine = (1 / factor, 0, middle[0], 0, 1 / factor, middle[1])
        picture = Image.fromarray(_colour(frame)).transform((width, height), Image.Transform.AFFINE, affine)
        return replace(frame, colour=np.asarray(picture))

    _plain(folder, [seen(frame) for frame in frames])
    return Given(f"{factor:.2f} times as large, {off_px[0]:.0f} {off_px[1]:.0f} px off", cause="colour.*depth")


def mirrored(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Depth or colour as in a mirror, or upside down."""
    axis, depth = int(rng.integers(2)), bool(rng.integers(2))
    flipped = [
        replace(frame, depth_m=np.flip(frame.depth_m, axis).copy())
        if depth
        else replace(frame, colour=np.flip(_colour(frame), axis).copy())
        for frame in frames
    ]
    _plain(folder, flipped)
    return Given(f"{'depth' if depth else 'colour'}, axis {axis}", cause="mirrored|upside down|colour.*depth")


def late(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Colour that is one frame late."""
    shift = int(rng.choice([-1, 1]))
    _plain(folder, [replace(one, colour=frames[(one.index + shift) % len(frames)].colour) for one in frames])
    return Given(f"by {shift}", cause="colour.*depth")


def stamps(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Depth and colour named by their own times; some colour is missing, some is of in between."""
    lag_s, period_s = float(rng.uniform(-0.02, 0.02)), float(rng.choice([0.1, 0.5, 1.0]))
    lost = rng.choice(len(frames), int(rng.integers(0, 4)), replace=False)
    between = rng.choice(len(frames), int(rng.integers(0, 4)), replace=False)
    for frame in frames:
        time_s = 1.7e9 + period_s * frame.index
        save(folder / "s" / "depth" / f"{time_s:.6f}.png", raw_depth(frame, 0.1))
        if frame.index not in lost:
            save(folder / "s" / "rgb" / f"{time_s + lag_s:.6f}.png", _colour(frame))
        if frame.index in between:
            save(folder / "s" / "rgb" / f"{time_s + 0.5 * period_s + lag_s:.6f}.png", _colour(frame))
    write_camera(folder / "s", frames[0].camera, depth_scale=0.1)
    return Given(f"{1e3 * lag_s:.0f} ms of {1e3 * period_s:.0f}, {len(lost)} lost, {len(between)} more")


def masks(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Masks with soft edges, a veil, of JPEG, thin, or of measured pixels alone."""
    kind = _pick(rng, ("soft", "veil", "JPEG", "thin", "measured only"))
    amount = int(rng.integers(2, 6))
    for frame in frames:
        mask, shown, suffix = _mask(frame), frame, "png"
        grey = mask * 255.0
        match kind:
            case "soft":
                grey = ndimage.gaussian_filter(grey, 0.5 * amount)
            case "veil":
                grey = np.maximum(grey, amount)
            case "JPEG":
                suffix = "jpg"
            case "thin":
                grey = ndimage.binary_erosion(mask, iterations=amount) * 255.0
            case _:
                kept = rng.random(mask.shape) < 0.25 / amount + 0.05
                shown = replace(frame, depth_m=np.where(kept, frame.depth_m, np.float32(np.nan)))
                grey = (mask & np.isfinite(shown.depth_m)) * 255.0
        save(folder / "s" / "masks" / f"{frame.index:03d}.{suffix}", grey.astype(np.uint8))
        _plain(folder, [shown])
    return Given(f"{kind}, {amount}")


def points(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Clouds: PLY or PCD, organised or not, all or the object, in axes of a camera, a viewer or a body."""
    kind = _pick(rng, [*clouds.WRITERS])
    turned = {
        "camera": np.eye(3),
        "viewer": np.diag([1.0, -1.0, -1.0]),
        "body": np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    }
    axes, organised, alone = _pick(rng, [*turned]), bool(rng.integers(2)), bool(rng.integers(2))
    suffix, write = clouds.WRITERS[kind]
    (folder / "s").mkdir()
    for frame in frames:
        shown = replace(frame, depth_m=np.where(_mask(frame), frame.depth_m, np.nan)) if alone else frame
        path = folder / "s" / f"cloud_{frame.index:02d}{suffix}"
        write(path, shown, clouds.Layout(turned[axes], organised))
    said = f"{kind}, {axes}, {'organised' if organised else 'no order'}, {'object' if alone else 'all'}"
    return Given(said)


def bags(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """A bag of ROS 1 or 2, packed in any way."""
    modes = rosbag2.CompressionMode
    packed, suffix = ((modes.NONE, ""), (modes.MESSAGE, ""), (modes.STORAGE, ""), (None, ".bag"), (None, ".db3"))[
        int(rng.integers(5))
    ]
    depth, colour = _pick(rng, ("16UC1", "32FC1", "compressedDepth")), _pick(rng, ("rgb8", "bgr8", "bgra8", "jpeg"))
    compression = rosbag1.Writer.CompressionFormat.LZ4 if suffix == ".bag" else None
    recorder = Recorder(depth, colour, compression=compression, packed=packed if packed is not modes.NONE else None)
    path = recorder.write(folder / f"s{suffix}", list(frames))
    said = f"{suffix or 'ROS 2'} {packed.name if packed else ''} {depth} {colour}"
    return Given(said, last=("build", f"{{in}}/{path.name}", "--out", "{out}/run"))


def unit(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """A unit of depth that is 10 or 1000 times too large or small."""
    factor = float(rng.choice([1e-3, 0.1, 10.0, 1e3]))
    path = _plain(folder, frames)
    write_camera(path, frames[0].camera, depth_scale=0.1 * factor)
    return Given(f"{factor:g} times", cause="unit|metres|depth.scale")


def values(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """65535 for no measurement, or the bytes of depth exchanged."""
    path, swapped = _plain(folder, frames), bool(rng.integers(2))
    for frame in frames:
        raw = raw_depth(frame, 0.1)
        raw = raw.byteswap() if swapped else np.where(raw == 0, 65535, raw).astype(np.uint16)
        save(path / "depth" / f"{frame.index:03d}.png", raw)
    return Given("bytes exchanged", cause="two bytes") if swapped else Given("65535")


def focal_length(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """A focal length that is off by up to a third, of images of twice the size, or a principal point with x for y."""
    camera, kind = frames[0].camera, int(rng.integers(3))
    factor = float(np.exp(rng.uniform(-0.3, 0.3)))
    wrong = (
        replace(camera, fx=factor * camera.fx, fy=factor * camera.fy),
        Camera(camera.width, camera.height, 2 * camera.fx, 2 * camera.fy, 2 * camera.cx, 2 * camera.cy),
        replace(camera, cx=camera.cy, cy=camera.cx),
    )[kind]
    write_camera(_plain(folder, frames), wrong, depth_scale=0.1)
    said = (f"{factor:.2f} times", "of twice the size", "cx and cy exchanged")[kind]
    return Given(said, cause="focal length|principal point|intrinsics")


def added(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Frames that come into the folder after a build."""
    count = int(rng.integers(7, 12))
    _plain(folder, frames[:count])
    resumed = ("build", "{in}/s", "--out", "{out}/run", "--resume")
    first = Given.last
    return Given(
        f"{len(frames) - count} later", commands=(first,), last=resumed, later=lambda: void(_plain(folder, frames))
    )


def void(_: object) -> None:
    """Return nothing."""


def sessions(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Two recordings of an object that stands alike in both, which share a few views."""
    shared = int(rng.integers(3, 6))
    half = (len(frames) + shared) // 2
    parts = range(half), range(len(frames) - half, len(frames))
    for name, part in zip("ab", parts, strict=True):
        _plain(folder / name, [replace(frames[k], index=place) for place, k in enumerate(part)])
    built = tuple(("build", f"{{in}}/{name}/s", "--out", f"{{out}}/{name}") for name in "ab")
    last = ("join", "{out}/a", "{out}/b", "--out", "{out}/run")
    return Given(f"{shared} shared", commands=built, last=last, shown=(*parts[0], *parts[1]))


def cut_off(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """An object of which the image cuts off a part, with masks or without."""
    given = bool(rng.integers(2))
    columns = np.flatnonzero(np.any([_mask(frame).any(axis=0) for frame in frames], axis=0))
    at = round(float(np.quantile(columns, rng.uniform(0.15, 0.4))))

    def cut(frame: Frame) -> Frame:
        camera = replace(frame.camera, width=frame.camera.width - at, cx=frame.camera.cx - at)
        depth_m, mask, colour = (image[:, at:].copy() for image in (frame.depth_m, _mask(frame), _colour(frame)))
        return replace(frame, depth_m=depth_m, mask=mask, colour=colour, camera=camera)

    shown = [cut(frame) for frame in frames]
    _plain(folder, shown)
    for frame in shown if given else ():
        save(folder / "s" / "masks" / f"{frame.index:03d}.png", _mask(frame).astype(np.uint8) * 255)
    return Given(f"{'with' if given else 'without'} masks, {at} px", cause="cut off|cuts off")


def as_it_is(folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Nothing is wrong."""
    _plain(folder, frames)
    return Given("")


WAYS: Final[Mapping[str, Way]] = {
    "as it is": as_it_is,
    "sizes": as_it_is,
    "formats of depth": formats,
    "names": names,
    "layouts, phones": layouts,
    "lenses": lenses,
    "named by angle": angles,
    "along the ray": along_ray,
    "colour of another camera": other_camera,
    "mirrored": mirrored,
    "colour a frame late": late,
    "time stamps": stamps,
    "masks": masks,
    "clouds": points,
    "bags": bags,
    "unit": unit,
    "values": values,
    "intrinsics": focal_length,
    "frames added": added,
    "two sessions": sessions,
    "cut off": cut_off,
}
"""By name; `sizes` differs in the scene."""


def put(name: str, folder: Path, frames: Sequence[Frame], rng: Rng) -> Given:
    """Write an input of a way into an empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return WAYS[name](folder, frames, rng)
