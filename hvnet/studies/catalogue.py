"""The paper's tables and figures as studies: a row is a config, configs/studies/NAME/ROW.yaml."""

from typing import NamedTuple


class Row(NamedTuple):
    """One line of a table: its config is configs/studies/STUDY/NAME.yaml."""

    name: str
    label: str
    paper: float | None = None  # BEV mAP, moderate, in %; ms in the study of speed


class Study(NamedTuple):
    """One table or figure."""

    shows: str
    source: str  # where in the paper
    rows: tuple[Row, ...]
    curves: tuple[tuple[str, ...], ...] = ()  # rows that the picture joins, where it shows mAP against time


STUDIES = {
    "components": Study(
        "what each part adds, from one scale without attention to the whole network",
        "ablation table, BEV mAP on KITTI's validation set",
        (
            Row("baseline", "baseline: VFE layers, no pyramid", 71.7),
            Row("attention", "+ attention", 73.76),
            Row("fpn", "+ FPN", 74.34),
            Row("ffpn", "+ FFPN instead", 75.18),
            Row("focal", "focal alpha 0.75 for pedestrians, cyclists", 75.71),
            Row("scale-2-feature", "+ scale 2*: two feature scales", 76.88),
            Row("scale-2", "+ scale 2: two projection scales, too", 77.88),
            Row("scale-3", "+ scale 3: three of both", 78.59),
        ),
    ),
    "scales": Study(
        "how many feature scales N_T and projection scales N_R are worth their time",
        "figure of N_T = 1..5 at N_R = 1 and N_R = 1..5 at N_T = 3; it prints no figures",
        tuple(Row(f"nt{n}", f"N_T = {n}, N_R = 1") for n in range(1, 6))
        + tuple(Row(f"nr{n}", f"N_T = 3, N_R = {n}") for n in range(1, 6)),
        (tuple(f"nt{n}" for n in range(1, 6)), tuple(f"nr{n}" for n in range(1, 6))),
    ),
    "voxel-size": Study(
        "PointPillars with its hard pillars against HVNet, over the size of a voxel",
        "figure of mAP against time; it prints no figures",
        (
            Row("pillars-0.16", "PointPillars, 0.16 m"),
            Row("pillars-0.20", "PointPillars, 0.20 m"),
            Row("pillars-0.24", "PointPillars, 0.24 m"),
            Row("hvnet-0.2", "HVNet, {0.1, 0.2} to 0.2 m"),
            Row("hvnet-0.3", "HVNet, {0.2, 0.3} to 0.3 m"),
            Row("hvnet-0.4", "HVNet, {0.2, 0.4} to 0.4 m"),
        ),
        (("pillars-0.16", "pillars-0.20", "pillars-0.24"), ("hvnet-0.2", "hvnet-0.3", "hvnet-0.4")),
    ),
    "speed": Study(
        "the time of an untrained network at the paper's setting, in all and stage by stage; trains nothing",
        "table of speed: ms on an RTX 2080 Ti",
        (
            Row("vfe", "PointPillars' VFE layer, one class", 34.0),
            Row("hsv", "hybrid voxels by index, one class", 32.0),
            Row("multi-class", "hybrid voxels by index, three classes", 35.0),
        ),
    ),
    "loss": Study(
        "corners against pose, and the losses and branches that the supplement tried",
        "supplement: mean of the classes' BEV AP on KITTI's validation set",
        (
            Row("corners", "corner loss", (88.90 + 69.76 + 77.13) / 3),
            Row("pose", "pose loss: x, y, l, w, theta", (87.67 + 68.37 + 73.34) / 3),
            Row("pose-10", "pose loss at ten times the weight"),
            Row("iou-branch", "+ IoU branch"),
            Row("iou-loss", "IoU loss"),
            Row("giou-loss", "GIoU loss"),
            Row("uncertainty", "learnt weights of the losses"),
            Row("direction", "+ direction branch"),
        ),
    ),
    "density": Study(
        "what the point limit of hard voxels costs, in points and in AP",
        "none: the paper only says that HVNet's voxels lose no point",
        (
            Row("lossless", "every point"),
            Row("limit-100", "100 points a voxel"),
            Row("limit-32", "32 points a voxel"),
            Row("limit-16", "16 points a voxel"),
            Row("limit-8", "8 points a voxel"),
        ),
    ),
}
