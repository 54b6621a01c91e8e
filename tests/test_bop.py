"""Sequences in BOP layout: reading undoes writing, and every fault is one line that names the file."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from recordings import png_claiming
from refusal import refused

from modeler import se3
from modeler.types import Camera, Frame, InputError
from sequences import BopSequence, frame_range, open_sequence, write_bop
from sequences.base import AbstractSequence

CAMERA = Camera(40, 30, 57.5, 58.5, 19.25, 14.75)
INDICES = (3, 7, 12)


def frame(index: int, rng: np.random.Generator) -> Frame:
    depth_m = rng.uniform(0.4, 6.0, (30, 40)).astype(np.float32)
    depth_m[rng.random((30, 40)) < 0.2] = np.nan
    mask = rng.random((30, 40)) < 0.5
    colour = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return Frame(index, 0.1 * index + 0.01, depth_m, CAMERA, mask, colour)


@pytest.fixture
def frames() -> list[Frame]:
    rng = np.random.default_rng(0)
    return [frame(index, rng) for index in INDICES]


@pytest.fixture
def truth() -> dict[int, np.ndarray]:
    rng = np.random.default_rng(1)
    return {index: se3.exp(rng.normal(size=6)) for index in INDICES}


META = {"name": "thing", "sensor": {"sigma_wh": 1e-3, "sigma_r_m": 2e-3}, "motion": {"kind": "table", "step_deg": 25}}


@pytest.fixture
def scene(tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]) -> Path:
    write_bop(tmp_path / "scene", frames, truth, META)
    return tmp_path / "scene"


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
    assert sequence.sensor() == (1e-3, 2e-3)
    assert sequence.motion == {"kind": "table", "step_deg": 25}


def test_writing_again_what_was_read_gives_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    sequence = BopSequence(scene)
    write_bop(tmp_path / "again", sequence, sequence.truth(), META)
    names = sorted(path.relative_to(scene) for path in scene.rglob("*") if path.is_file())
    assert names == sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*") if p.is_file())
    for name in names:
        if name.name != "scene_gt.json":  # digits of the rotation may move by one in the last place
            assert (scene / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_a_sequence_can_be_read_twice(scene: Path) -> None:
    sequence = BopSequence(scene)
    for first, second in zip(sequence, sequence, strict=True):
        np.testing.assert_array_equal(first.depth_m, second.depth_m)
    assert len(sequence) == len(list(sequence)) == 3


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
    assert colour is not None
    assert colour.shape == (30, 40, 3)
    assert (colour == grey).all()


def test_jpeg_colour_is_read(tmp_path: Path, frames: list[Frame]) -> None:
    flat = [Frame(f.index, f.time_s, f.depth_m, f.camera, None, np.full((30, 40, 3), 99, np.uint8)) for f in frames]
    write_bop(tmp_path / "s", flat, colour_suffix=".jpg")
    assert (tmp_path / "s" / "rgb" / "000003.jpg").is_file()
    colour = BopSequence(tmp_path / "s").frame(3).colour
    assert colour is not None
    assert np.abs(colour.astype(int) - 99).max() <= 2


# --- selection ---


@given(
    every=st.integers(1, 4),
    start=st.none() | st.integers(0, 14),
    stop=st.none() | st.integers(0, 14),
)
def test_selection_is_a_slice_of_frame_numbers(every: int, start: int | None, stop: int | None) -> None:
    whole = Numbers(INDICES)
    wanted = [i for i in INDICES if i in range(0 if start is None else start, 99 if stop is None else stop)][::every]
    if not wanted:
        with pytest.raises(InputError, match=r"leaves nothing .* 3 to 12, 3 frames"):
            whole.select(every, slice(start, stop))
        return
    part = whole.select(every, slice(start, stop))
    assert list(part.indices) == wanted == [f.index for f in part]
    assert part.name == whole.name
    part_truth = part.truth()
    assert part_truth is not None
    assert list(part_truth) == wanted
    for index in set(INDICES) - set(wanted):
        with pytest.raises(InputError, match="not among the selected"):
            part.frame(index)


class Numbers(AbstractSequence):
    """Empty frames of given numbers."""

    def __init__(self, numbers: tuple[int, ...]) -> None:
        self.numbers = numbers

    @property
    def name(self) -> str:
        return "numbers"

    @property
    def indices(self) -> tuple[int, ...]:
        return self.numbers

    def frame(self, index: int) -> Frame:
        return Frame(index, float(index), np.zeros((30, 40), np.float32), CAMERA)

    def truth(self) -> dict[int, np.ndarray] | None:
        return {index: np.eye(4) for index in self.numbers}

    def sensor(self) -> None:
        return None

    @property
    def motion(self) -> None:
        return None

    @property
    def robot_path(self) -> None:
        return None

    @property
    def model_path(self) -> None:
        return None


@pytest.mark.parametrize(
    ("text", "expected"),
    [("3:9", slice(3, 9)), (":4", slice(None, 4)), ("2:", slice(2, None)), (":", slice(None, None))],
)
def test_ranges_of_frames_are_read(text: str, expected: slice) -> None:
    assert frame_range(text) == expected


@pytest.mark.parametrize("text", ["", "3", "a:b", "1:2:3", "-1:3", "1.5:2", "\u0661:\u0662"])
def test_other_ranges_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="A:B"):
        frame_range(text)


def test_every_zeroth_frame_is_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        Numbers(INDICES).select(0)


# --- faults ---


def edit_json(name: str, change: Callable[[dict], object]) -> Callable[[Path], object]:
    def damage(scene: Path) -> None:
        content = json.loads((scene / name).read_text())
        change(content)
        (scene / name).write_text(json.dumps(content))

    return damage


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
    "cam_K zero": (set_k(0, 0.0), "at least 1"),
    "cam_K negative": (set_k(4, -575.0), "at least 1"),
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
    "sensor half": (edit_json(S, lambda c: c["sensor"].pop("sigma_wh")), "sigma_wh"),
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


@given(seed=st.integers(0, 2**32 - 1))
def test_no_damage_to_a_picture_escapes(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = tmp_path_factory.mktemp("s") / "scene"
    write_bop(scene, [frame(0, rng)])
    target = scene / ("depth/000000.png", "rgb/000000.png", "mask_visib/000000_000000.png")[seed % 3]
    content = bytearray(target.read_bytes())
    for place in rng.integers(8, len(content), 3):
        content[place] = rng.integers(256)
    target.write_bytes(content)
    message = str(scene)
    try:
        assert BopSequence(scene).frame(0).depth_m.shape == (30, 40)
    except InputError as error:
        message = str(error)
    assert str(scene) in message
    assert "\n" not in message


def test_a_missing_folder_and_frame_are_named(tmp_path: Path, scene: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        open_sequence(tmp_path / "nowhere")
    with pytest.raises(InputError, match="a file of this kind holds no sequence"):
        open_sequence(scene / "scene_camera.json")
    with pytest.raises(InputError, match=r"no frame 4; .* 3 to 12, 3 frames"):
        open_sequence(scene).frame(4)


# --- writing ---


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
