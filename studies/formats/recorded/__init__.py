"""Small recordings that libraries of cameras' makers and of formats' authors wrote, and the programs for it.

They run by themselves, where NumPy and the library are; no camera is needed:

    pip install numpy pyrealsense2==2.56.5.9235 && python realsense.py realsense-2.56.bag && xz realsense-2.56.bag
    pip install numpy pyrealsense2==2.59.1.11053 && python realsense.py realsense-2.59-yuyv.db3 && xz *-yuyv.db3
    pip install numpy pillow pyk4a-bundle==1.5.0 && python kinect.py kinect.mkv kinect_pixels.json && xz kinect.mkv
    pip install numpy mcap-ros2-support==0.6.0 && python foxglove.py foxglove.mcap && xz foxglove.mcap
"""

import lzma
from pathlib import Path

FOLDER = Path(__file__).parent


def unpacked(name: str, folder: Path) -> Path:
    """Put a recording into a folder."""
    (folder / name).write_bytes(lzma.decompress((FOLDER / f"{name}.xz").read_bytes()))
    return folder / name
