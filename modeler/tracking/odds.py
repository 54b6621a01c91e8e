"""The odds that a frame shows a model in a pose, and those of poses against each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeler import se3
from modeler.kernels import point_likelihood
from modeler.registration.visibility.likelihood import PairLikelihood
from modeler.types import Array, RayImage

# Wrong poses that the search reaches, and share of a frame's patches that match in one: measured on absent objects,
# 100 in the mean, and 0.36 of 3 to 10 patches (0.2 of more).
_POSES, _CHANCE = 100.0, 0.36


def log_odds(pair: PairLikelihood, fine_m: float) -> float:
    """Return the log (nats) of the odds that a frame shows the model in the pose in which it is rendered.

    The likelihood counts 0 where surface matches as well as in a true pose, and here where nothing was measured, as in
    the shadows of what hides the object. Of other surface, each patch matches by chance alone, in one of the poses of
    the search (method, eq. 15.1).

    Args:
        pair: frame and model.
        fine_m: least noise of matching surface.
    """
    pose, here = np.eye(4), se3.rows(np.eye(4))
    noise_m = max(pair.noises_m(pose, fine_m)[0], fine_m)
    matched = float(np.mean(pair.forward.classify(here) == point_likelihood.MATCHED))
    surface = pair.temper * float(pair.without_holes().scores(pose[None], noise_m, stride=1).surface[0])
    return surface - pair.backward.image.patches * matched * np.log(_CHANCE) - np.log(_POSES)


def relative_weights(pairs: Sequence[PairLikelihood], view: RayImage, fine_m: float) -> Array:
    """Return relative weights (k,) of poses: those of Gaussians about the means, under the noise of the best match.

    Args:
        pairs: frame and model, rendered in each of the poses.
        view: the frame.
        fine_m: least noise of matching surface.
    """
    here = np.eye(4)
    blur_m = max(min(pair.noises_m(here, fine_m)[0] for pair in pairs), fine_m)
    widest = np.diag(1.0 / np.repeat([1.0, view.size_m], 3) ** 2)
    logs = [
        pair.without_holes().tempered(here[None], blur_m)[0]
        - 0.5 * np.linalg.slogdet(pair.curvatures(here[None], blur_m, stride=1)[0] + widest)[1]
        for pair in pairs
    ]
    return np.exp(np.array(logs) - max(logs))
