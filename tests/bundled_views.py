"""Views of a bundled sequence."""

from modeler.evaluation import true_motion
from modeler.sequences import bundled, open_sequence
from modeler.types import Array, RayImage
from modeler.views import Sensor


def views(name: str, source: int, target: int) -> tuple[RayImage, RayImage, Array]:
    """Return two frames made ready, source and target, and the true target_from_source (4, 4)."""
    sequence = open_sequence(bundled(name))
    truth, noise = sequence.truth(), sequence.sensor()
    assert truth is not None
    assert noise is not None
    made = [Sensor(noise).ray_image(sequence.frame(index)) for index in (source, target)]
    return made[0], made[1], true_motion(truth, target=target, source=source)
