"""Where everything lives in a recording: entity paths, timelines and colours, in one place."""

from typing import Final

APPLICATION: Final = "modeler"

# Timelines
FRAME: Final = "frame"
ELAPSED: Final = "elapsed"

# The camera image, in pixels.
CAMERA: Final = "camera"
COLOUR: Final = "camera/colour"
DEPTH: Final = "camera/depth"
MASK: Final = "camera/mask"

# The newest pair of views, in the target's camera frame.
PAIR: Final = "pair"
PAIR_TARGET: Final = "pair/target"
PAIR_BEFORE: Final = "pair/source_before"
PAIR_AFTER: Final = "pair/source_after"
PAIR_AXES: Final = "pair/mean_axes"
PAIR_DRAWS: Final = "pair/posterior_draws"

# The object frame.
WORLD: Final = "world"
CLOUD: Final = "world/model/cloud"
MESH: Final = "world/model/mesh"
CAMERAS: Final = "world/poses/cameras"
AXES: Final = "world/poses/axes"
CURRENT: Final = "world/poses/current"
CHAIN: Final = "world/poses/chain_before_closure"
ODOMETRY: Final = "world/edges/odometry"
CLOSURE: Final = "world/edges/closure"
REJECTED: Final = "world/edges/rejected"
POSITION_1_SIGMA: Final = "world/uncertainty/position_1_sigma"
POSITION_3_SIGMA: Final = "world/uncertainty/position_3_sigma"
AXIS_TIPS_1_SIGMA: Final = "world/uncertainty/axis_tips_1_sigma"
MAGNIFICATION: Final = "world/uncertainty/magnification"

# Readings over time. Each has the series `odometry` and `closure`; the first two also `pose`.
ROTATION_SD: Final = "readings/rotation_sd_deg"
TRANSLATION_SD: Final = "readings/translation_sd_mm"
EFFECTIVE_SAMPLES: Final = "readings/effective_samples"
OVERLAP: Final = "readings/overlap_percent"
SECONDS: Final = "readings/seconds_per_pair"
READINGS: Final = (ROTATION_SD, TRANSLATION_SD, EFFECTIVE_SAMPLES, OVERLAP, SECONDS)
SERIES: Final = ("odometry", "closure", "pose")
POSE_READINGS: Final = (ROTATION_SD, TRANSLATION_SD)

# Words
NOW: Final = "words/now"
LOG: Final = "words/log"
LEGEND: Final = "words/legend"

Rgb = tuple[int, int, int]
TARGET_RGB: Final[Rgb] = (64, 190, 200)
SOURCE_RGB: Final[Rgb] = (255, 150, 50)
ODOMETRY_RGB: Final[Rgb] = (235, 235, 235)
CLOSURE_RGB: Final[Rgb] = (70, 220, 110)
REJECTED_RGB: Final[Rgb] = (240, 60, 60)
CAMERA_RGB: Final[Rgb] = (130, 145, 165)
CURRENT_RGB: Final[Rgb] = SOURCE_RGB
CHAIN_RGB: Final[Rgb] = (120, 100, 160)
UNCERTAINTY_RGB: Final[Rgb] = (255, 225, 90)
AXIS_RGB: Final[tuple[Rgb, Rgb, Rgb]] = ((230, 70, 70), (80, 200, 80), (90, 130, 255))

LEGEND_TEXT: Final = """\
- **Pair**: new view orange, the view it is aligned to teal, in the latter's camera frame. Dots are where the ends of
the axes land under samples of the posterior.
- **Poses**: a pyramid is the camera as the object saw it, the newest orange. Odometry edges are white, closures
green, rejected ones red; violet is the chain without closure.
- **Uncertainty**: yellow ellipsoids are the position within 1 sd (solid) and 3 sd (wire), discs at the axes' tips the
rotation within 1 sd, magnified by the factor written under the object.
- **Readings**: white odometry, green closure, yellow the newest pose after optimisation. Sd along the worst axis;
translation is that of the object's centre.
"""
