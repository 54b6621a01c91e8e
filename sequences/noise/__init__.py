"""The noise of a depth camera, across and along the ray: measured, stored, and told of a sequence."""

from sequences.noise.model import NoiseModel as NoiseModel
from sequences.noise.model import read_noise as read_noise
from sequences.noise.sensed import SensedSequence as SensedSequence
