"""Entity paths, timelines and colours of a recording."""

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
OUTLINE: Final = "camera/outline"
DEPTH_OUTLINE: Final = "camera/depth_outline"

# The newest pair of views, in the target's camera frame.
PAIR: Final = "pair"
PAIR_TARGET: Final = "pair/target"
PAIR_BEFORE: Final = "pair/source_before"
PAIR_AFTER: Final = "pair/source_after"
PAIR_CAPTION: Final = "pair/caption"
PAIR_AXES: Final = "pair/mean_axes"
PAIR_DRAWS: Final = "pair/posterior_draws"
GHOSTS: Final = "pair/ghosts"
GHOST_MEANS: Final = "pair/ghost_means"
GHOST_TIPS: Final = "pair/ghost_axis_tips"
GHOST_CENTRE_1_SIGMA: Final = "pair/ghost_centre_1_sigma"
GHOST_CENTRE_3_SIGMA: Final = "pair/ghost_centre_3_sigma"
GHOST_LABELS: Final = "pair/ghost_labels"

# The target's image with the source's points in it, in pixels.
VISIBILITY: Final = "visibility"
VISIBILITY_AREAS: Final = "visibility/areas"
VISIBILITY_AGREES: Final = "visibility/points_that_agree"
VISIBILITY_HIDDEN: Final = "visibility/points_hidden"
VISIBILITY_NO_SAY: Final = "visibility/points_without_measurement"
VISIBILITY_VIOLATIONS: Final = "visibility/points_in_front"
VISIBILITY_CAPTION: Final = "visibility/caption"

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
EDGES_1_SIGMA: Final = "world/uncertainty/edges_1_sigma"
EDGES_MAGNIFICATION: Final = "world/uncertainty/edges_magnification"
MAGNIFICATION: Final = "world/uncertainty/magnification"
BEFORE_POSITION_3_SIGMA: Final = "world/before/position_3_sigma"
MERGED_BEFORE: Final = "world/merged/before_closure"
MERGED_AFTER: Final = "world/merged/after_closure"

# The object in its camera's frame.
TRACKED: Final = "tracked"
TRACKED_MODEL: Final = "tracked/model"
TRACKED_MESH: Final = "tracked/model/mesh"
TRACKED_POINTS: Final = "tracked/points"
TRACKED_PLACE_3_SIGMA: Final = "tracked/place_3_sigma"
TRACKED_WORDS: Final = "tracked/words"

# Readings over time. Each has the series `odometry` and `closure`; the first two also `pose`.
ROTATION_SD: Final = "readings/rotation_sd_deg"
TRANSLATION_SD: Final = "readings/translation_sd_mm"
EFFECTIVE_SAMPLES: Final = "readings/effective_samples"
OVERLAP: Final = "readings/overlap_percent"
SECONDS: Final = "readings/seconds_per_pair"
TURNED: Final = "readings/turned_deg"
READINGS: Final = (TURNED, ROTATION_SD, TRANSLATION_SD, EFFECTIVE_SAMPLES, OVERLAP, SECONDS)
SERIES: Final = ("odometry", "closure", "pose")
POSE_READINGS: Final = (ROTATION_SD, TRANSLATION_SD)

# Words
NOW: Final = "words/now"
POSES: Final = "words/poses"
LOG: Final = "words/log"
RUN: Final = "words/run"
LEGEND: Final = "words/legend"

Rgb = tuple[int, int, int]
TARGET_RGB: Final[Rgb] = (64, 190, 200)
SOURCE_RGB: Final[Rgb] = (255, 150, 50)
ODOMETRY_RGB: Final[Rgb] = (235, 235, 235)
CLOSURE_RGB: Final[Rgb] = (70, 220, 110)
REJECTED_RGB: Final[Rgb] = (240, 60, 60)
CAMERA_RGB: Final[Rgb] = (130, 145, 165)
BEFORE_RGB: Final[Rgb] = (165, 125, 240)
MODE_RGB: Final[tuple[Rgb, ...]] = (SOURCE_RGB, (200, 120, 255), (120, 210, 90), (255, 110, 130), (110, 170, 255))
AREAS_RGB: Final[tuple[Rgb, Rgb, Rgb]] = ((0, 0, 0), (128, 128, 128), (45, 85, 190))
HIDDEN_RGB: Final[Rgb] = (120, 80, 45)
NO_SAY_RGB: Final[Rgb] = (70, 70, 70)
VIOLATION_RGB: Final[Rgb] = (255, 40, 160)
OUTLINE_RGB: Final[Rgb] = (90, 255, 120)
UNCERTAINTY_RGB: Final[Rgb] = (255, 225, 90)
AXIS_RGB: Final[tuple[Rgb, Rgb, Rgb]] = ((230, 70, 70), (80, 200, 80), (90, 130, 255))

LEGEND_TEXT: Final = """\
**Poses and uncertainty.** Pyramids are camera poses around the object, which is drawn as if it stood still; the newest
is orange. Around each position lies an ellipsoid: the region within 3 standard deviations (sd), which holds the true
position with 97 % probability. Violet: before loop closure, along the violet chain of consecutive pairs, where
errors add up. Yellow: after it, solid within 1 sd. The green line is a closure: a registration to a view that the
object had turned away from. All ellipsoids are magnified by the factor written below them. The table lists the sd of
each pose relative to the first, along its least certain axis; translation is that of the object's centre.

**Object.** Pink surface was not observed by any view; it closes the mesh. After the last frame, the points of all
views are shown next to it, with the poses before and after loop closure, coloured by frame from blue to yellow. Before
closure, yellow points lie apart from blue ones if the loop closure error is large.

**Newest pair.** New view orange, the view it is registered to teal, in the camera frame of the latter. *Posterior*: the
distribution over relative poses that the registration returns, its spread magnified by the factor written there; the
object is drawn at the mean and, dimmed, at samples; dots are the ends of its axes, yellow ellipsoids its centre
within 1 and 3 sd. Further modes (separate poses that explain the images too) have other colours and are labelled with
their probabilities. *New points in previous view*: what that view measured (blue: object, grey: background, black:
nothing) with the new points projected into it: orange points agree with the surface measured there, brown ones are
hidden behind it, **pink ones lie in front of what was measured**, which few points do at the true pose.

**Edges.** An edge is a registration that the pose graph takes in: odometry joins a frame to the previous one, spans
join frames several steps apart (both white), closures are green, rejected registrations red; the ellipsoid on an edge
is the 1 sd region of its translation. Plots: the angle by which a pair turned; overlap: how much of the surface that
both views should see, both saw; sd along the least certain axis; effective samples: how many independent samples the
posterior is worth. White: odometry; green: closure; yellow: the newest pose after optimisation.
"""
