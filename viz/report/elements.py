"""Pieces of HTML that hold pictures."""

from __future__ import annotations

import base64


def figure(picture: bytes, caption: str, *, style: str = "", kind: str = "svg+xml") -> str:
    """Return a picture with a caption.

    Args:
        picture: the file's bytes.
        caption: in HTML.
        style: the picture's class.
        kind: its media type, after `image/`.
    """
    image = f"<img class='{style}' src='{data_address(picture, kind)}' alt=''>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def data_address(content: bytes, kind: str) -> str:
    """Return an address that is the picture itself, whose media type is `image/` and `kind`."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
