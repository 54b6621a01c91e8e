"""BOP scenes: what is written is what is read, nothing is half written, and every fault is one line."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bop_scenes import CAMERA, INDICES, META, random_frames, random_truth, written
from input_errors import refused
from PIL import Image

from modeler.sequences import BopSequence, open_sequence, survey, write_bop
from modeler.types import NOMINAL_FOCAL, Frame, InputError, SensorNoise
from studies.formats.image_folders import png_claiming


@pytest.fixture
def frames() -> list[Frame]:
    return random_frames()


@pytest.fixture
def truth() -> dict[int, np.ndarray]:
    return random_truth()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return written(tmp_path / "scene")


def test_reading_undoes_writing(scene: Path, frames: list[Frame], truth: dict[int, np.ndarray]) -> None:
    sequence = open_sequence(scene)
    assert sequence.indices == INDICES
    for wrote, read in zip(frames, sequence, strict=True):
        assert (read.index, read.camera) == (wrote.index, wrote.camera)
        assert read.time_s == wrote.time_s
        assert read.depth_m.dtype == np.float32
        np.testing.assert_array_equal(np.isnan(read.depth_m), np.isnan(wrote.depth_m))
        np.testing.assert_allclose(read.depth_m, wrote.depth_m, rtol=0, atol=0.5e-4 + 1e-6)  # half of 0.1 mm
        np.testing.assert_array_equal(read.mask, wrote.mask)  # type: ignore[arg-type]
        np.testing.assert_array_equal(read.colour, wrote.colour)  # type: ignore[arg-type]
    read_truth = sequence.truth()
    assert read_truth is not None
    assert tuple(read_truth) == INDICES
    for index in INDICES:
        np.testing.assert_allclose(read_truth[index], truth[index], atol=1e-12)
    assert sequence.name == "thing"
    assert sequence.sensor() == SensorNoise(1e-3, 2e-3, sigma_focal=NOMINAL_FOCAL)
    assert sequence.motion == {"kind": "table", "step_deg": 25}


def test_writing_again_what_was_read_gives_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    sequence = BopSequence(scene)
    write_bop(tmp_path / "again", sequence, sequence.truth(), META)
    names = sorted(path.relative_to(scene) for path in scene.rglob("*") if path.is_file())
    assert names == sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    for name in names:
        if name.name != "scene_gt.json":  # digits of the rotation may move by one in the last place
            assert (scene / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_a_bare_scene_has_neither_truth_nor_mask_nor_colour(tmp_path: Path, frames: list[Frame]) -> None:
    bare = [Frame(f.index, f.time_s, f.depth_m, f.camera) for f in frames]
    write_bop(tmp_path / "bare", bare)
    (tmp_path / "bare" / "sequence.json").unlink()
    sequence = BopSequence(tmp_path / "bare")
    assert sequence.name == "bare"
    assert (
        sequence.truth() is sequence.sensor() is sequence.motion is sequence.robot_path is sequence.model_path is None
    )
    for read in sequence:
        assert read.mask is None
        assert read.colour is None
        assert read.time_s == read.index  # no times known


def test_the_hand_and_the_model_are_found(tmp_path: Path, frames: list[Frame]) -> None:
    write_bop(tmp_path / "s", frames, files={"robot.txt": b"# hand\n", "model.ply": b"ply\n"})
    sequence = BopSequence(tmp_path / "s")
    assert sequence.robot_path == tmp_path / "s" / "robot.txt"
    assert sequence.select(every=2).model_path == tmp_path / "s" / "model.ply"


@pytest.mark.parametrize(("mode", "grey"), [("L", 77), ("I;16", 77)])
def test_grey_pictures_become_rgb(scene: Path, mode: str, grey: int) -> None:
    pixels = np.full((30, 40), grey if mode == "L" else grey * 256 + 13, np.uint8 if mode == "L" else np.uint16)
    Image.fromarray(pixels).save(scene / "rgb" / "000003.png")
    colour = BopSequence(scene).frame(3).colour
    assert colour.shape == (30, 40, 3)
    assert (colour == grey).all()


def test_jpeg_colour_is_read(tmp_path: Path, frames: list[Frame]) -> None:
    flat = [Frame(f.index, f.time_s, f.depth_m, f.camera, None, np.full((30, 40, 3), 99, np.uint8)) for f in frames]
    write_bop(tmp_path / "s", flat, colour_suffix=".jpg")
    assert (tmp_path / "s" / "rgb" / "000003.jpg").is_file()
    colour = BopSequence(tmp_path / "s").frame(3).colour
    assert np.abs(colour.astype(int) - 99).max() <= 2


def test_nothing_is_left_of_a_failed_write(tmp_path: Path, frames: list[Frame]) -> None:
    def failing():
        yield frames[0]
        raise RuntimeError("camera fell over")

    with pytest.raises(RuntimeError, match="fell over"):
        write_bop(tmp_path / "s", failing())
    assert list(tmp_path.iterdir()) == []


def test_a_full_folder_is_not_overwritten(scene: Path, frames: list[Frame]) -> None:
    before = {path: path.read_bytes() for path in scene.rglob("*.*")}
    with pytest.raises(InputError, match="exists already"):
        write_bop(scene, frames)
    assert before == {path: path.read_bytes() for path in scene.rglob("*.*")}


def test_an_empty_folder_is_filled(tmp_path: Path, frames: list[Frame]) -> None:
    (tmp_path / "s").mkdir()
    write_bop(tmp_path / "s", frames)
    assert BopSequence(tmp_path / "s").indices == INDICES


def test_depth_beyond_16_bits_is_refused(tmp_path: Path, frames: list[Frame]) -> None:
    far = Frame(0, 0.0, np.full((30, 40), 7.0, np.float32), CAMERA)
    with pytest.raises(InputError, match=r"7\.00 m does not fit"):
        write_bop(tmp_path / "s", [far])
    assert not (tmp_path / "s").exists()
    write_bop(tmp_path / "s", [far], depth_scale_mm=1.0)


def test_real_scenes_are_read() -> None:
    data = Path(__file__).parents[2] / "shared" / "data"
    if not data.is_dir():
        pytest.skip("the real sequences are not here")
    for name, count in (("cap", 19), ("dragon", 15)):
        sequence = open_sequence(data / name)
        assert len(sequence) == count
        first = sequence.frame(sequence.indices[0])
        assert (first.colour is None) == (name == "dragon")
        truth = sequence.truth()
        assert truth is not None
        assert tuple(truth) == sequence.indices
        assert 0.3 < np.nanmedian(first.depth_m) < 4.0


def entered(scene: Path, name: str, change: Callable[[dict], object]) -> None:
    tree = json.loads((scene / name).read_text())
    change(tree)
    (scene / name).write_text(json.dumps(tree))


def test_masks_of_no_frame_are_reported(scene: Path) -> None:
    assert BopSequence(scene).notes == ()
    masks = sorted((scene / "mask_visib").iterdir())
    masks[0].rename(masks[0].with_name("mask0.png"))
    (note,) = BopSequence(scene).notes
    assert f"1 of {len(masks)} " in note
    assert "mask0.png" in note
    (scene / "mask_visib").rename(scene / "masks")
    (note,) = BopSequence(scene).notes
    assert "those in masks/ are left out" in note


def test_a_changing_depth_scale_is_reported(scene: Path) -> None:
    entered(scene, "scene_camera.json", lambda tree: tree[str(INDICES[1])].update(depth_scale=1.0))
    (note,) = BopSequence(scene).notes
    assert {"depth_scale", "0.1", "1"} <= set(note.split())


POKE = {"point_m": [0, 0, 1], "direction": [1, 0, 0], "length_m": 0.1}


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ({"kind": "rocket"}, "turntable, held"),
        ({"kind": ["table"]}, "one of general"),
        ({"kind": "turntable", "step_deg": 1e308}, "a number from -360 to 360"),
        ({"kind": "turntable", "step_deg": float("nan")}, "step_deg"),
        ({"kind": "turntable", "step_deg": "25"}, "step_deg"),
        ({"kind": "turntable", "step-deg": 25}, "did you mean step_deg?"),
        ({"kind": "table", "colour": 1}, "step_deg, sigma_deg"),
        ({"kind": "table", "sigma_deg": -1}, "sigma_deg"),
        ({"kind": "poke", "pokes": {"one": {}}}, "is not a frame number"),
        ({"kind": "poke", "pokes": {"1": POKE | {"point_m": [0, 0]}}}, "point_m"),
        (
            {"kind": "poke", "pokes": {"1": {"point_m": [0, 0, 1], "direction": [0, 0, 0], "length_m": 0.1}}},
            "direction",
        ),
        ([], "an object"),
    ],
)
def test_motion_is_read_strictly(scene: Path, motion: object, words: str) -> None:
    entered(scene, "sequence.json", lambda tree: tree.update(motion=motion))
    with refused("sequence.json", words):
        BopSequence(scene)


@pytest.mark.parametrize("name", ["\ud800", "a\u0007b", " "])
def test_names_can_be_printed(scene: Path, name: str) -> None:
    entered(scene, "sequence.json", lambda tree: tree.update(name=name))
    with refused("sequence.json", '"name"', "printable"):
        BopSequence(scene)


def test_focal_lengths_are_those_of_cameras(scene: Path) -> None:
    def focal_px(fx: float, fy: float) -> Callable[[dict], object]:
        def change(tree: dict) -> None:
            for entry in tree.values():
                entry["cam_K"][0], entry["cam_K"][4] = fx, fy

        return change

    entered(scene, "scene_camera.json", focal_px(1e7, 1e7))
    with refused("scene_camera.json", "fx and fy from 1 to 1e6"):
        BopSequence(scene)
    entered(scene, "scene_camera.json", focal_px(1.0, 1.0))
    with refused("focal length"):
        survey(BopSequence(scene))
    entered(scene, "scene_camera.json", focal_px(500.0, 100.0))
    assert any("are the focal lengths right?" in doubt for doubt in survey(BopSequence(scene)).doubts)


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".jpg"])
def test_depth_of_other_formats_is_refused_by_name(scene: Path, suffix: str) -> None:
    for path in (scene / "depth").iterdir():
        path.rename(path.with_suffix(suffix))
    with refused(suffix, "16-bit PNG and TIFF are read"):
        BopSequence(scene)


# Whatever is wrong with a BOP scene is said in one line.


def edit_json(name: str, change: Callable[[dict], object]) -> Callable[[Path], object]:
    return lambda scene: entered(scene, name, change)


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda scene: (scene / name).write_bytes(content)


def picture(name: str, pixels: np.ndarray) -> Callable[[Path], object]:
    return lambda scene: Image.fromarray(pixels).save(scene / name)


def truncate(name: str) -> Callable[[Path], object]:
    return lambda scene: (scene / name).write_bytes((scene / name).read_bytes()[:-300])


def flip_bytes(name: str) -> Callable[[Path], object]:
    def damage(scene: Path) -> None:
        content = bytearray((scene / name).read_bytes())
        content[len(content) // 2] ^= 0xFF
        (scene / name).write_bytes(content)

    return damage


def set_k(place: int, value: object) -> Callable[[Path], object]:
    return edit_json("scene_camera.json", lambda c: c["7"]["cam_K"].__setitem__(place, value))


U16, U8 = np.full((30, 40), 700, np.uint16), np.full((30, 40), 7, np.uint8)
D, C, G, S = "depth/000007.png", "scene_camera.json", "scene_gt.json", "sequence.json"
FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "depth text": (write(D, b"hello"), D),
    "depth empty": (write(D, b""), D),
    "depth truncated": (truncate(D), D),
    "depth corrupt": (flip_bytes(D), D),
    "depth 8 bit": (picture(D, U8), "16-bit"),
    "depth colour": (picture(D, np.zeros((30, 40, 3), np.uint8)), "16-bit"),
    "depth other size": (picture(D, np.zeros((31, 40), np.uint16)), "40 x 31"),
    "depth swapped size": (picture(D, np.zeros((40, 30), np.uint16)), "30 x 40"),
    "depth bomb": (write(D, png_claiming(60000, 60000)), "million pixels"),
    "depth large": (write(D, png_claiming(10000, 9500)), "million pixels"),
    "depth a folder": (lambda s: ((s / D).unlink(), (s / D).mkdir()), D),
    "depth twice": (picture("depth/7.png", U16), "remove one"),
    "no depth": (lambda s: [p.unlink() for p in (s / "depth").iterdir()], "holds no depth"),
    "mask broken": (truncate("mask_visib/000007_000000.png"), "mask_visib"),
    "mask other size": (picture("mask_visib/000007_000000.png", U8[:20]), "40 x 20"),
    "rgb broken": (flip_bytes("rgb/000007.png"), "rgb"),
    "rgb other size": (picture("rgb/000007.png", np.zeros((60, 80, 3), np.uint8)), "80 x 60"),
    "no cameras": (lambda s: (s / C).unlink(), C),
    "cameras not JSON": (write(C, b'{"3": {"cam_K": [1,'), "line 1"),
    "cameras not UTF-8": (write(C, b"\xff\xfe{}"), "UTF-8"),
    "cameras deep": (write(C, b"[" * 200000), "not valid JSON"),
    "cameras a list": (write(C, b"[]"), "object"),
    "cameras odd key": (edit_json(C, lambda c: c.update(first=1)), "frame number"),
    "camera missing": (edit_json(C, lambda c: c.pop("7")), "frame 7"),
    "camera a number": (edit_json(C, lambda c: c.update({"7": 5})), "object"),
    "no cam_K": (edit_json(C, lambda c: c["7"].pop("cam_K")), "cam_K"),
    "cam_K short": (edit_json(C, lambda c: c["7"]["cam_K"].pop()), "9 finite numbers"),
    "cam_K text": (set_k(0, "575"), "9 finite numbers"),
    "cam_K null": (set_k(2, None), "9 finite numbers"),
    "cam_K zero": (set_k(0, 0.0), "fx and fy from 1 to 1e6"),
    "cam_K negative": (set_k(4, -575.0), "fx and fy from 1 to 1e6"),
    "cam_K NaN": (set_k(0, float("nan")), "finite"),
    "cam_K huge": (set_k(0, 10**400), "finite"),
    "cam_K skew": (set_k(1, 3.0), "fx, 0, cx"),
    "cam_K transposed": (edit_json(C, lambda c: c["7"].update(cam_K=[57, 0, 0, 0, 57, 0, 19, 14, 1])), "fx, 0, cx"),
    "no depth_scale": (edit_json(C, lambda c: c["7"].pop("depth_scale")), "depth_scale"),
    "depth_scale zero": (edit_json(C, lambda c: c["7"].update(depth_scale=0)), "depth_scale"),
    "depth_scale per metre": (edit_json(C, lambda c: c["7"].update(depth_scale=1000)), "depth_scale"),
    "truth not JSON": (write(G, b"nope"), G),
    "truth no list": (edit_json(G, lambda c: c.update({"7": {}})), "list"),
    "truth no rotation": (edit_json(G, lambda c: c["7"][0].pop("cam_R_m2c")), "cam_R_m2c"),
    "truth not a rotation": (
        edit_json(G, lambda c: c["7"][0].update(cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, 2])),
        "rotation",
    ),
    "truth a mirror": (edit_json(G, lambda c: c["7"][0].update(cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, -1])), "rotation"),
    "truth of another object": (edit_json(G, lambda c: c["7"][0].update(obj_id=9)), "same object"),
    "sequence not JSON": (write(S, b"{"), S),
    "sequence a list": (write(S, b"[]"), "object"),
    "name a number": (edit_json(S, lambda c: c.update(name=3)), "text"),
    "sensor a text": (edit_json(S, lambda c: c.update(sensor="kinect")), "object"),
    "sensor half": (edit_json(S, lambda c: c.update(sensor={"sigma": 1e-3})), "sigma_r_m"),
    "sensor negative": (edit_json(S, lambda c: c["sensor"].update(sigma_r_m=-1)), "sigma_r_m"),
    "motion a text": (edit_json(S, lambda c: c.update(motion="table")), "object"),
    "times lack one": (edit_json(S, lambda c: c["timestamps_s"].pop("7")), "frame 7"),
    "times stand still": (edit_json(S, lambda c: c["timestamps_s"].update({"7": 0.0})), "frame 7"),
    "times a text": (edit_json(S, lambda c: c["timestamps_s"].update({"7": "noon"})), "finite number"),
}


def read_all(scene: Path) -> None:
    sequence = open_sequence(scene)
    list(sequence)
    sequence.truth()


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_one_line_that_names_the_folder(scene: Path, fault: str) -> None:
    damage, says = FAULTS[fault]
    damage(scene)
    with refused(says, str(scene)):
        read_all(scene)


def test_a_missing_folder_and_frame_are_named(tmp_path: Path, scene: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        open_sequence(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"scene_camera\.json"):
        open_sequence(scene / "scene_camera.json")
    with pytest.raises(InputError, match=r"frame 4\b.* 3 to 12"):
        open_sequence(scene).frame(4)
