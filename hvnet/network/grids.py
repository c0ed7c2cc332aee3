"""The grids of a config's projection scales."""

from hvnet.config import EncoderConfig
from hvnet.kernels.voxel import Grid, make_grid


def pyramid_depth(config: EncoderConfig) -> int:
    """Blocks of the main stream: three, or one a projection scale; each but the first halves the map."""
    return max(3, len(config.projection_scales))


def projection_grids(config: EncoderConfig) -> list[Grid]:
    """The grids of S_R, finest first; the finest is padded so that every block of the backbone may halve it evenly."""
    finest = make_grid(config.point_range, config.voxel_size, config.projection_scales[0], 2 ** pyramid_depth(config))
    grids = [finest]
    for _ in config.projection_scales[1:]:
        last = grids[-1]
        grids.append(
            last._replace(
                cell=(2 * last.cell[0], 2 * last.cell[1]),
                cells=(-(-last.cells[0] // 2), -(-last.cells[1] // 2)),
                shape=(last.shape[0] // 2, last.shape[1] // 2),
            )
        )
    return grids
