"""Whatever is wrong with folders of pictures is said in one line, and nothing is left behind."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_runner import Run
from PIL import Image

from modeler.cli import main
from modeler.sequences import open_sequence
from studies.formats.image_folders import png_claiming, save

Damage = Callable[[Path], object]


def second(pattern: str) -> Callable[[Path], Path]:
    return lambda folder: sorted(folder.glob(pattern))[1]


def content(pattern: str, data: bytes) -> Damage:
    return lambda folder: second(pattern)(folder).write_bytes(data)


def cut(pattern: str) -> Damage:
    def damage(folder: Path) -> None:
        path = second(pattern)(folder)
        path.write_bytes(path.read_bytes()[:-200])

    return damage


def pixels(pattern: str, change: Callable[[np.ndarray], np.ndarray], *, every: bool = False) -> Damage:
    def damage(folder: Path) -> None:
        for path in sorted(folder.glob(pattern)) if every else [second(pattern)(folder)]:
            with Image.open(path) as picture:
                found = np.asarray(picture)
            save(path, change(found))

    return damage


def text(name: str, change: Callable[[str], str]) -> Damage:
    return lambda folder: (folder / name).write_text(change((folder / name).read_text()))


def entry(name: str, change: Callable[[dict], object]) -> Damage:
    def damage(folder: Path) -> None:
        tree = json.loads((folder / name).read_text())
        change(tree)
        (folder / name).write_text(json.dumps(tree))

    return damage


def without(pattern: str) -> Damage:
    return lambda folder: second(pattern)(folder).unlink()


def gone(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def folder_instead(pattern: str, *, place: int = 1) -> Damage:
    def damage(folder: Path) -> None:
        path = sorted(folder.glob(pattern))[place]
        path.unlink()
        path.mkdir()

    return damage


def link_out(pattern: str, *, place: int = 1) -> Damage:
    def damage(folder: Path) -> None:
        path = sorted(folder.glob(pattern))[place]
        outside = folder.parent / "outside" / path.name
        outside.parent.mkdir(exist_ok=True)
        path.rename(outside)
        path.symlink_to(outside)

    return damage


def swap_lines(first: int, other: int) -> Callable[[str], str]:
    def change(lines: str) -> str:
        rows = lines.splitlines()
        rows[first], rows[other] = rows[other], rows[first]
        return "\n".join(rows)

    return change


def again(line: int) -> Callable[[str], str]:
    return lambda lines: "\n".join([*lines.splitlines()[: line + 1], *lines.splitlines()[line:]])


def smaller(image: np.ndarray) -> np.ndarray:
    return image[:-7]


def eight_bit(image: np.ndarray) -> np.ndarray:
    return (image >> 4).astype(np.uint8)


def to_metres(image: np.ndarray) -> np.ndarray:
    return np.rint(image / 1000.0).astype(np.uint16)


D = "depth/*.png"
PICTURES: dict[str, tuple[Damage, str]] = {
    "truncated": (cut(D), "not a readable PNG"),
    "empty": (content(D, b""), "not a readable PNG"),
    "text": (content(D, b"no picture"), "not a readable PNG"),
    "wrong bit depth": (pixels(D, eight_bit), "8-bit image; depth must be a 16-bit"),
    "colour for depth": (pixels(D, lambda image: np.stack([eight_bit(image)] * 3, axis=2)), "a colour image; depth"),
    "wrong size": (pixels(D, smaller), " is 160 x 120, "),
    "all zero": (pixels(D, np.zeros_like, every=True), "none of its 3 frames holds any depth, all is 0 or NaN"),
    "decompression bomb": (content(D, png_claiming(100_000, 100_000)), "million pixels"),
    "directory instead of a picture": (folder_instead(D), ".png"),
    "no pictures": (lambda folder: [path.unlink() for path in folder.glob(D)], "depth"),
}
B, O, K, T = "scene_camera.json", "camera_intrinsic.json", "cam_K.txt", "depth.txt"  # noqa: E741
M, C = "masks/*.png", "rgb/*.png"
FAULTS: dict[str, dict[str, tuple[Damage, str]]] = {
    "bop": {  # more in test_bop
        "truncated": PICTURES["truncated"],
        "all zero": PICTURES["all zero"],
        "metres for millimetres": (pixels(D, to_metres, every=True), "it looks like metres"),
        "millimetres per metre": (
            entry(B, lambda c: [camera.update(depth_scale=0.001) for camera in c.values()]),
            "it looks like metres",
        ),
        "masks empty": (pixels("mask_visib/*.png", np.zeros_like, every=True), "masks mark nothing"),
        "number of 400 digits": (entry(B, lambda c: c["1"].update(depth_scale=10**400)), "depth_scale"),
        "key of 5000 digits": (entry(B, lambda c: c.update({"9" * 5000: {}})), "frame number"),
        "truth of wrong types": (entry("scene_gt.json", lambda c: c.update({"1": "x"})), "must be a list"),
    },
    "tum": {
        **PICTURES,
        "metres for millimetres": (pixels(D, lambda i: np.rint(i / 5000.0).astype(np.uint16), every=True), "metres"),
        "no intrinsics": (gone("calibration.txt"), "no intrinsics for images of 160 x 120"),
        "intrinsics of words": (text("calibration.txt", lambda t: "fx fy cx cy"), "calibration.txt"),
        "focal length 0": (text("calibration.txt", lambda t: "0 0 80 60"), "does not describe a pinhole camera"),
        "list truncated": (text(T, lambda t: t[:-30]), T),
        "list a folder": (folder_instead(T, place=0), T),
        "list empty": (text(T, lambda t: "# nothing\n"), "lists no depth image"),
        "list not text": (lambda folder: (folder / T).write_bytes(b"\xff\xfe\0"), "not UTF-8"),
        "time twice": (text(T, again(3)), "line 5: its time is the same as that of the line above"),
        "times out of order": (text(T, swap_lines(2, 3)), "line 4: its time comes before that of the line above"),
        "time no number": (text(T, lambda t: t.replace("1305031102.5", "noon")), "is not a time"),
        "time infinite": (text(T, lambda t: t.replace("1305031102.500000 ", "inf ")), "is not a time"),
        "missing picture": (without(D), "which is not there"),
        "a picture elsewhere": (text(T, lambda t: t.replace(" depth/", " ../outside/")), "leads out of the sequence"),
        "name of control characters": (text(T, lambda t: t.replace(" depth/", " \0depth/")), "control characters"),
        "colour missing": (without(C), "rgb.txt: names rgb/"),
        "colour of another size": (pixels(C, smaller), "colour and masks must be aligned to depth"),
        "truth no quaternion": (text("groundtruth.txt", lambda t: t.replace(" 0.", " 7.")), "unit quaternion"),
        "truth short": (text("groundtruth.txt", lambda t: t[:-20]), "groundtruth.txt"),
    },
    "open3d": {
        **PICTURES,
        "metres for millimetres": (pixels(D, to_metres, every=True), "it looks like metres; correct the depth scale"),
        "no intrinsics": (gone(O), "no intrinsics; add camera.json"),
        "colour of a coarser size": (pixels("color/*.jpg", lambda i: i[::2, ::2]), "colour and masks must be aligned"),
        "intrinsics empty": (text(O, lambda t: ""), "not valid JSON"),
        "intrinsics lacking": (text(O, lambda t: "{}"), "intrinsics, with fx, fy, cx and cy in px, or with"),
        "matrix of text": (entry(O, lambda c: c["intrinsic_matrix"].__setitem__(0, "575")), "9 finite numbers"),
        "matrix singular": (entry(O, lambda c: c["intrinsic_matrix"].__setitem__(0, 0)), "pinhole camera"),
        "matrix a list": (text(O, lambda t: "[1, 2]"), "must be an object"),
        "intrinsics a folder": (folder_instead(O, place=0), O),
        "colour of another size": (pixels("color/*.jpg", smaller), "colour and masks must be aligned to depth"),
        "colour truncated": (cut("color/*.jpg"), "not a readable PNG or JPEG"),
        "truth cut": (text("trajectory.log", lambda t: t[:-150]), "trajectory.log"),
        "truth of words": (text("trajectory.log", lambda t: t.replace("0.", "x.")), "rigid motion"),
    },
    "bundlesdf": {
        "metres for millimetres": (pixels(D, to_metres, every=True), "it looks like metres"),
        "intrinsics short": (text(K, lambda t: t.splitlines()[0]), "does not describe a pinhole camera"),
        "intrinsics NaN": (text(K, lambda t: t.replace("1.4375", "nan ").replace("nan 0", "nan")), K),
        "intrinsics skewed": (lambda folder: np.savetxt(folder / K, np.ones((3, 3))), "pinhole camera"),
        "mask of another size": (pixels(M, smaller), "160 x 113"),
        "mask broken": (cut(M), "not a readable PNG"),
        "masks empty": (pixels(M, np.zeros_like, every=True), "masks mark nothing"),
        "two pictures of one name": (
            lambda f: shutil.copy(next(f.glob(C)), next(f.glob(C)).with_suffix(".jpg")),
            "too",
        ),
        "truth no rotation": (content("annotated_poses/*.txt", b"1 0 0 0\n" * 4), "no rigid motion"),
        "sequence.json wrong": (lambda folder: (folder / "sequence.json").write_text('{"sensor": 3}'), "sensor"),
    },
}


@pytest.mark.parametrize(("kind", "fault"), [(kind, fault) for kind, faults in FAULTS.items() for fault in faults])
def test_every_fault_is_one_line_and_leaves_nothing(
    written: Path, tmp_path: Path, refusal: Callable[..., str], kind: str, fault: str
) -> None:
    folder = tmp_path / "in"
    shutil.copytree(written / kind, folder)
    damage, says = FAULTS[kind][fault]
    damage(folder)
    estimates = not fault.startswith("truth")  # which never looks at the ground truth
    assert says in refusal(*(("build", folder, "--out", tmp_path / "run") if estimates else ("info", folder)))
    assert {path.name for path in tmp_path.iterdir()} <= {"in", "outside"}


LINKS = [
    *((kind, D) for kind in FAULTS),
    *((kind, "depth") for kind in FAULTS),
    *(("bop", name) for name in (B, "scene_gt.json", "sequence.json", "mask_visib/*.png")),
    *(("tum", name) for name in (T, "groundtruth.txt", C)),
    *(("open3d", name) for name in (O, "trajectory.log")),
    *(("bundlesdf", name) for name in (K, "annotated_poses/*.txt")),
]


@pytest.mark.parametrize("kind", FAULTS)
def test_intact_sequences_are_read_with_strict_paths(written: Path, kind: str) -> None:
    """Or the faults above would prove nothing."""
    assert main(["info", str(written / kind), "--strict-paths"]) == 0


@pytest.mark.parametrize(("kind", "linked"), LINKS)
def test_links_out_of_a_sequence_are_followed_unless_paths_are_strict(
    written: Path, tmp_path: Path, refusal: Callable[..., str], kind: str, linked: str
) -> None:
    folder = tmp_path / "in"
    shutil.copytree(written / kind, folder)
    link_out(linked, place=0)(folder)
    sequence, intact = open_sequence(folder), open_sequence(written / kind)
    for frame, wanted in zip(sequence, intact, strict=True):
        for name in ("depth_m", "mask", "colour"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(wanted, name))
        assert (frame.time_s, frame.camera) == (wanted.time_s, wanted.camera)
    np.testing.assert_equal(sequence.truth(), intact.truth())
    said = refusal("convert", folder, "--out", tmp_path / "run", "--strict-paths")
    assert f"leads out of the sequence, to {tmp_path / 'outside'}" in said
    if (kind, linked) == ("bop", D):
        refusal("build", folder, "--out", tmp_path / "run", "--strict-paths")
    assert {path.name for path in tmp_path.iterdir()} == {"in", "outside"}


def test_what_is_given_as_a_scale_is_checked(written: Path, refusal: Callable[..., str]) -> None:
    assert "it looks like millimetres" in refusal("info", written / "tum", "--depth-scale-mm", "1000")
    for option in ("--depth-scale-mm -1", "--intrinsics 0 1 2 3", "--intrinsics nan 1 2 3"):
        refusal("info", written / "tum", *option.split())


def test_single_empty_frames_are_named_and_left_out(written: Path, tmp_path: Path, cli: Run) -> None:
    shutil.copytree(written / "bop", tmp_path / "in")
    pixels(D, np.zeros_like)(tmp_path / "in")
    pixels("mask_visib/*2_*.png", np.zeros_like, every=True)(tmp_path / "in")
    status, said, _ = cli("info", tmp_path / "in")
    assert status == 0
    assert "no measurement at all in frames 1: they will be left out" in said
    assert "nothing measured inside the mask in frames 2: they will be left out" in said
