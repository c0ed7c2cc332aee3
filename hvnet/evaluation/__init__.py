"""KITTI's evaluation, for any class: rules, matching, precision, tables; and what a detector gets wrong."""
