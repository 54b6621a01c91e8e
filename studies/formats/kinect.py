"""Writes recordings as the Azure Kinect does: raw 16-bit big-endian depth, JPEG colour, the calibration attached."""

from __future__ import annotations

import importlib
import json
import struct
from pathlib import Path

import numpy as np

from studies.formats.recorded.kinect import calibration

WIDTH, HEIGHT = 320, 288  # NFOV_2X2BINNED
COLOUR_SIZE = (1280, 720)


def write_mkv(path: Path, count: int = 3, *, attached: dict | None = None, colour: bool = True) -> list[np.ndarray]:
    """Write a recording of a slanted plane and return its raw depth images."""
    av = importlib.import_module("av")
    container = av.open(str(path), "w", format="matroska", options={"allow_raw_vfw": "1"})
    depth = container.add_stream("rawvideo", rate=30)
    depth.width, depth.height, depth.pix_fmt = WIDTH, HEIGHT, "gray16be"
    depth.metadata["title"] = "DEPTH"
    tracks = [depth]
    if colour:
        picture = container.add_stream("mjpeg", rate=30)
        picture.width, picture.height, picture.pix_fmt = *COLOUR_SIZE, "yuvj420p"
        picture.metadata["title"] = "COLOR"
        tracks.append(picture)
    content = json.dumps(calibration() if attached is None else attached).encode()
    container.add_attachment("calibration.json", "application/octet-stream", content + b"\0")
    images = []
    for place in range(count):
        slope = np.linspace(600.0, 1200.0, WIDTH)[None, :] + 5.0 * place + np.zeros((HEIGHT, 1))
        raw = np.rint(slope).astype(np.uint16)
        raw[:20, :20] = 0
        images.append(raw)
        frame = av.VideoFrame.from_ndarray(raw, format="gray16le").reformat(format="gray16be")
        frame.pts = place
        container.mux(depth.encode(frame))
        if colour:
            half = np.full((COLOUR_SIZE[1], COLOUR_SIZE[0], 3), (200, 40, 40), np.uint8)
            half[:, COLOUR_SIZE[0] // 2 :] = (40, 40, 200)
            frame = av.VideoFrame.from_ndarray(half, format="rgb24")
            frame.pts = place
            container.mux(tracks[1].encode(frame))
    for track in tracks:
        container.mux(track.encode())
    container.close()
    # The library leaves out which kind of raw image it is; recorders of the camera say b16g.
    written = path.read_bytes()
    header = struct.pack("<IiiHHI", 40, WIDTH, -HEIGHT, 1, 16, 0)
    assert header in written
    path.write_bytes(written.replace(header, struct.pack("<IiiHH", 40, WIDTH, HEIGHT, 1, 16) + b"b16g"))
    return images
