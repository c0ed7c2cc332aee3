"""HVNet: hybrid voxel network for LiDAR based 3D object detection (CVPR 2020), on NVIDIA Warp kernels.

`hvnet.load()` gives a detector, `detector(points)` gives boxes; `hvnet.kernels` can be used without the network.
"""

from typing import TYPE_CHECKING

from hvnet.exceptions import InputError

if TYPE_CHECKING:
    from hvnet.network.detector import Detector, load

__all__ = ["Detector", "InputError", "__version__", "load"]
__version__ = "0.2.0"

if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        """Lazy, so that importing the kernels does not load the network."""
        if name in ("load", "Detector"):
            from hvnet.network import detector

            return getattr(detector, name)
        raise AttributeError(f"module 'hvnet' has no attribute {name!r}")
