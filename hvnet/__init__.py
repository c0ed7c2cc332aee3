"""HVNet: hybrid voxel network for LiDAR based 3D object detection (CVPR 2020), on NVIDIA Warp kernels."""
