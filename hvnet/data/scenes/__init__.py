"""Generated scenes: a street of meshes (street, shapes), scanned by a simulated LiDAR (scanner), as files (files)."""
