"""Whatever is wrong with a BOP scene is said in one line."""

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
from small_scene import frame, written

from modeler.types import InputError
from sequences import BopSequence, open_sequence, write_bop


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return written(tmp_path / "scene")


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
