"""The study of objects that a hand turns in front of the camera: a robot's, with a regrasp, or a person's."""
