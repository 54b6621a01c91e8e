"""The shapes of the study: their recipes, which half each is in, and its symmetry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, final

import numpy as np

from modeler.sequences.rendering.cameras import Lamp, Photography
from modeler.sequences.rendering.labels import Faces, Label, Print
from modeler.sequences.rendering.recipe import Recipe, builtin_recipes, load_recipe

Half = Literal["tuning", "held-out"]
Symmetry = Literal[
    "asymmetric",
    "near-symmetric",
    "n-fold",
    "revolution",
    "n-fold, labelled",
    "n-fold, faint",
    "n-fold, plain",
    "revolution, labelled",
    "revolution, faint",
    "revolution, plain",
]


@final
@dataclass(frozen=True)
class Specimen:
    """One shape of the study."""

    recipe: str
    """Name of its recipe, of this folder or built in; `can+faint` is the can with a faint print."""
    symmetry: Symmetry
    """Its class; a near-symmetric shape is a body of revolution except for something small."""
    half: Half
    """Whether methods may be tuned on it."""


_FOLDER: Final = Path(__file__).with_name("recipes")


def recipe_names() -> tuple[str, ...]:
    """Return the names of all recipes, of this folder and built in."""
    return tuple(sorted({*builtin_recipes(), *(path.stem for path in _FOLDER.glob("*.json"))}))


def load_specimen(name: str) -> Recipe:
    """Return the recipe of a name, from this folder or built in; with a finish after a plus sign, printed and lit."""
    shape, _, finish = name.partition("+")
    path = _FOLDER / f"{shape}.json"
    recipe = load_recipe(path if path.is_file() else shape)
    return printed(recipe, CONTRASTS[finish]) if finish else recipe


CONTRASTS: Final[Mapping[str, float]] = {"labelled": 1.0, "faint": 0.1, "plain": 0.0}
"""How strong the print is, by finish."""


def printed(recipe: Recipe, contrast: float) -> Recipe:
    """Return a recipe printed on all sides, under lamps of its own.

    Print and lamps are drawn by the recipe's seed: the finishes of one shape differ in contrast alone.
    """
    rng = np.random.default_rng(recipe.seed)
    lamps = []
    for strength in rng.uniform(0.1, 0.4, rng.integers(2, 4)):
        # From above or from a window, never from behind the object, where it would be in the picture.
        across, down, towards = rng.uniform((-1.0, -1.0, 0.4), (1.0, 0.5, 1.0))
        lamps.append(Lamp((float(across), float(down), float(-towards)), float(strength)))
    photography = Photography(
        ambient=float(rng.uniform(0.2, 0.4)),
        lamps=tuple(lamps),
        highlight=float(rng.uniform(0.0, 1.0)),
        highlight_exponent=float(np.exp(rng.uniform(np.log(8.0), np.log(60.0)))),
        samples=2,
    )
    label = Label(Print(seed=recipe.seed, contrast=contrast), Faces(lids=True))
    return replace(recipe, label=label, photography=photography, colour="png")


FRAMES: Final = 2
"""Frames of each shape under each condition, one more than pairs."""

# After an evaluation, held-out shapes may be used for tuning: they move over, and new ones replace them.
_RECIPES: Final[Mapping[Half, Mapping[Symmetry, tuple[str, ...]]]] = {
    "tuning": {
        "asymmetric": (
            "l_bracket",
            "wedge",
            "figurine",
            "drill",
            "iron",
            "toy_car",
            "watering_can",
            "stapler",
            "boot",
            "vise",
            "microscope",
            "rubber_duck",
            "hand_plane",
            "desk_lamp",
            "trowel",
            "locomotive",
            "sewing_machine",
            "excavator",
            "telephone",
            "tape_dispenser",
            "computer_mouse",
            "dinosaur",
            "whistle",
            "sitting_cat",
            "faucet",
            "tugboat",
            "meat_grinder",
            "stand_mixer",
            "snail",
            "armchair",
            "helicopter",
            "anvil",
            "gramophone",
            "coffee_machine",
            "pipe_elbow",
            "hole_punch",
            "fox",
            "g_clamp",
            "camera",
            "wheelbarrow",
            "hair_dryer",
            "glue_gun",
            "angle_grinder",
            "forklift",
            "rocking_horse",
            "crane",
        ),
        "near-symmetric": (
            "flashlight",
            "mug",
            "teapot",
            "spray_can",
            "saucepan",
            "chamberstick",
            "jug",
            "pepper_mill",
            "oil_can",
            "globe",
            "mortar",
            "cactus",
            "robot_vacuum",
            "fire_extinguisher",
            "pear",
            "beaker",
            "kitchen_timer",
            "thermos",
            "paint_tin",
            "rice_cooker",
            "camera_lens",
            "bicycle_bell",
            "candle",
            "snowman",
            "soap_dispenser",
            "lighthouse",
            "pedal_bin",
            "pocket_watch",
            "matryoshka",
            "buoy",
            "milk_churn",
            "gas_cylinder",
            "door_knob",
            "apple",
            "pressure_gauge",
            "oil_filter",
            "tea_tin",
            "smoke_detector",
            "measuring_cup",
            "toothbrush",
            "fire_hydrant",
            "kettle",
            "cheese_wheel",
            "beer_keg",
            "demijohn",
        ),
        "n-fold": (
            "box",
            "two_fold",
            "four_fold",
            "casserole",
            "toy_brick",
            "handwheel",
            "stool",
            "square_bottle",
            "toolbox",
            "lantern",
            "padlock",
            "bench_grinder",
            "propeller",
            "skateboard",
            "tripod",
            "stepper_motor",
            "muffin_tin",
            "cleat",
            "hourglass",
            "fidget_spinner",
            "table_lamp",
            "bundt_cake",
            "balance_scale",
            "picnic_table",
            "snack_server",
            "clamp_knob",
            "quadcopter",
            "carousel",
            "menorah",
            "napkin_holder",
            "citrus_squeezer",
            "eiffel_tower",
            "ashtray",
            "gazebo",
            "wing_nut",
            "tetrapod",
            "star_cutter",
            "pencil_holder",
            "gear_wheel",
            "trivet",
            "toast_rack",
            "impeller",
            "pagoda",
            "bridge",
            "rocket",
            "water_tower",
        ),
        "revolution": (
            "tube",
            "dumbbell",
            "can",
            "bottle",
            "bowl",
            "goblet",
            "bowling_pin",
            "vase",
            "soup_plate",
            "funnel",
            "jar",
            "cart_wheel",
            "light_bulb",
            "plunger",
            "stacking_rings",
            "cake_stand",
            "spinning_top",
            "rolling_pin",
            "hat",
            "handbell",
            "yo_yo",
            "cocktail_shaker",
            "flower_pot",
            "thread_spool",
            "mushroom",
            "desk_bell",
            "dog_bowl",
            "tajine",
            "candlestick",
            "chess_pawn",
            "doughnut",
            "egg_cup",
            "beehive",
            "barrel",
            "pan_lid",
            "inkwell",
            "ramekin",
            "pulley",
            "petri_dish",
            "pipe_reducer",
            "insulator",
            "spittoon",
            "honey_dipper",
            "lampshade",
            "bell_jar",
            "decanter",
            "djembe",
        ),
    },
    "held-out": {
        "asymmetric": (
            "hatchet",
            "hose_nozzle",
            "elephant",
            "jigsaw",
            "high_heel",
            "grand_piano",
            "staircase",
            "chaise",
            "tow_truck",
            "ice_skate",
            "parrot",
            "dustpan",
        ),
        "near-symmetric": (
            "tankard",
            "birdhouse",
            "gumball_machine",
            "samovar",
            "bomb",
            "igloo",
            "coconut_drink",
            "sugar_shaker",
            "oil_lamp",
            "tree_stump",
            "acorn",
            "honey_jar",
        ),
        "n-fold": (
            "canoe",
            "open_wrench",
            "sawhorse",
            "see_saw",
            "triskelion",
            "lathe_chuck",
            "three_legged_pot",
            "pipe_cross",
            "lug_wrench",
            "square_table",
            "hex_bolt",
            "snowflake",
        ),
        "revolution": (
            "erlenmeyer_flask",
            "traffic_cone",
            "tumbler",
            "urn",
            "piston",
            "wok",
            "flying_saucer",
            "bobbin",
            "suction_cup",
            "birdbath",
            "crucible",
            "baluster",
        ),
    },
}

SPECIMENS: Final = tuple(
    Specimen(recipe, symmetry, half)
    for half, classes in _RECIPES.items()
    for symmetry, recipes in classes.items()
    for recipe in recipes
)
"""All of them."""

_PRINTED: Final[Mapping[Half, Mapping[Literal["n-fold", "revolution"], tuple[str, ...]]]] = {
    "tuning": {
        "n-fold": ("tea_box", "box", "two_fold", "four_fold", "square_bottle", "toolbox", "lantern", "table_lamp"),
        "revolution": ("orange", "can", "bottle", "tube", "bowl", "vase", "jar", "soup_plate"),
    },
    "held-out": {
        "n-fold": ("carton", "canoe", "three_legged_pot", "square_table", "hex_bolt", "lathe_chuck"),
        "revolution": ("beach_ball", "erlenmeyer_flask", "tumbler", "urn", "crucible", "baluster"),
    },
}
# Written out, for a type checker does not compose literals.
_CLASSES: Final[Mapping[tuple[str, str], Symmetry]] = {
    ("n-fold", "labelled"): "n-fold, labelled",
    ("n-fold", "faint"): "n-fold, faint",
    ("n-fold", "plain"): "n-fold, plain",
    ("revolution", "labelled"): "revolution, labelled",
    ("revolution", "faint"): "revolution, faint",
    ("revolution", "plain"): "revolution, plain",
}

PRINTED: Final = tuple(
    Specimen(f"{recipe}+{finish}", _CLASSES[symmetry, finish], half)
    for half, classes in _PRINTED.items()
    for symmetry, recipes in classes.items()
    for finish in CONTRASTS
    for recipe in recipes
)
"""Shapes whose depth leaves turns open, with a strong print, with a faint one, and with none, under lamps."""
