"""The shapes of the study: their recipes, which half each is in, and its symmetry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, final

from sequences.rendering.recipe import Recipe, builtin_recipes, load_recipe

Half = Literal["tuning", "held-out"]
Symmetry = Literal["asymmetric", "near-symmetric", "n-fold", "revolution"]


@final
@dataclass(frozen=True)
class Specimen:
    """One shape of the study."""

    recipe: str
    """Name of its recipe, of this folder or built in."""
    symmetry: Symmetry
    """Its class; a near-symmetric shape is a body of revolution but for something small."""
    half: Half
    """Whether methods may be tuned on it."""


_FOLDER: Final = Path(__file__).with_name("recipes")


def recipe_names() -> tuple[str, ...]:
    """Return the names of all recipes, of this folder and built in."""
    return tuple(sorted({*builtin_recipes(), *(path.stem for path in _FOLDER.glob("*.json"))}))


def load_specimen(name: str) -> Recipe:
    """Return the recipe of a name, from this folder or built in."""
    path = _FOLDER / f"{name}.json"
    return load_recipe(path if path.is_file() else name)


FRAMES: Final = 2
"""Frames of each shape under each condition, one more than pairs."""

# A half that has been looked at may be tuned on from then on: its shapes move over, and new ones take their place.
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
        ),
    },
    "held-out": {
        "asymmetric": (
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
}

SPECIMENS: Final = tuple(
    Specimen(recipe, symmetry, half)
    for half, classes in _RECIPES.items()
    for symmetry, recipes in classes.items()
    for recipe in recipes
)
"""All of them."""
