"""The network, from points to boxes: grids, encoder, backbone, anchors, head, loss, model, detector."""
