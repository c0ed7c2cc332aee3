"""Data sets: KITTI in its own layout, generated scenes, the ground-truth database, augmentation."""
