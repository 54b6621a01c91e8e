"""Frames that come while they are used: from a camera, or from another program that writes them."""
