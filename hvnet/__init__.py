"""HVNet: hybrid voxel network for LiDAR based 3D object detection (CVPR 2020), on NVIDIA Warp kernels.

`hvnet.load()` gives a detector, `detector(points)` gives boxes; `hvnet.kernels` stands on its own.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    if name in ("load", "Detector"):  # on first use: who wants the kernels alone need not import the network
        from hvnet.network import detector

        return getattr(detector, name)
    raise AttributeError(f"module 'hvnet' has no attribute {name!r}")
