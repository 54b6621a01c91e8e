"""How well a camera is followed live."""
