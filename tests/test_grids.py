"""The grids of the projection scales."""

from hvnet.config import EncoderConfig
from hvnet.kernels.voxel import Grid
from hvnet.network.grids import projection_grids


def test_projection_grids_are_padded_and_halved() -> None:
    config = EncoderConfig(projection_scales=(1.5, 3.0, 6.0))  # 0.3 m: 213.33 cells
    grids = projection_grids(config)
    assert [grid.cells for grid in grids] == [(214, 214), (107, 107), (54, 54)]
    assert [grid.shape for grid in grids] == [(216, 216), (108, 108), (54, 54)]
    assert isinstance(grids[0], Grid)
