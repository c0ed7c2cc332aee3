"""The head's maps as rows of anchors."""

import torch

from hvnet.network.head import anchor_rows


def test_anchor_rows_have_the_order_of_the_anchors() -> None:
    """A map that holds its own x, y and channel shows where each row comes from."""
    n_l, n_w, per_cell, values = 3, 5, 4, 2
    x, y, c = torch.meshgrid(torch.arange(n_l), torch.arange(n_w), torch.arange(per_cell * values), indexing="ij")
    output = (100 * x + 10 * y + c).permute(2, 0, 1)[None].float()
    rows = anchor_rows(output, values)[0]
    assert rows.shape == (n_l * n_w * per_cell, values)
    assert rows[(1 * n_w + 3) * per_cell + 2].tolist() == [100 + 30 + 4, 100 + 30 + 5]
