"""The study of objects that a hand holds and turns before the camera: a robot's, which takes it anew, or a person's."""
