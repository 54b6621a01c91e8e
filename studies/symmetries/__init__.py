"""Whether the symmetries found are those of shapes of known class."""
