"""Calibrates scores: of the boxes with a score of 0.5, half are right.

After training they are too high: frames with inserted objects hold many more than a street does, the focal loss weighs
objects of rare classes more than the background, and a score is the mean of two, whether there is an object and how
well its box fits.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from hvnet.data.frame import Frames, frame_at
from hvnet.evaluation.mistakes import judge
from hvnet.evaluation.rules import Rule, config_rules
from hvnet.evaluation.scoring import detect_frame
from hvnet.network.detector import Detector

ROUNDS = 10
CLOSE = 0.01
"""Logits. A score that is off by this at 0.5 is 0.4975 or 0.5025."""


def calibrate(detector: Detector, frames: Frames) -> list[float]:
    """Shifts the logits of a detector's classes until half of the boxes with a score of 0.5 are right in these frames.

    A box is right if it has the loose BEV overlap of its class with a label (KITTI: 0.5 for cars, 0.25 for people).
    What KITTI does not score counts for nothing. Boxes of a class keep their order, but for what the predicted IoU
    changes. A class is left as it is where nothing is known of it: see `boundary`. After ROUNDS passes through the
    frames the shifts stay as they are.

    Returns the shifts, by which the bias of every class's score has grown. Raises ValueError for a detector that is not
    in float32, whose biases would be rounded, and for a frame without labels; InputError naming a frame that cannot be
    read.
    """
    if detector.dtype != torch.float32:
        raise ValueError(f"want a detector in float32, got {detector.dtype}")
    rules = {name: rule._replace(strict=rule.loose) for name, rule in config_rules(detector.config).items()}
    shifts = [0.0] * len(rules)
    for _ in range(ROUNDS):
        off = [boundary(scores, right) for scores, right in judged_scores(detector, frames, rules)]
        for label, logit in enumerate(off):
            shifts[label] -= logit
            detector.score_maps.score_bias(label).sub_(logit)
        if max(map(abs, off)) < CLOSE:
            break
    return shifts


def judged_scores(detector: Detector, frames: Frames, rules: Mapping[str, Rule]) -> list[tuple[Tensor, Tensor]]:
    """By class the scores (M,) of what a detector finds in labelled frames, and whether it is right (M,)."""
    every: list[list[tuple[Tensor, Tensor]]] = [[] for _ in rules]
    for k in range(len(frames)):
        frame = frame_at(frames, k)
        found = detect_frame(detector, frame)
        verdicts = judge(frame, found, rules)
        for label, parts in enumerate(every):
            own = (found.labels == label) & (verdicts.right | verdicts.wrong)
            parts.append((found.scores[own], verdicts.right[own]))
    return [(torch.cat(scores), torch.cat(right)) for scores, right in (zip(*parts, strict=True) for parts in every)]


def boundary(scores: Tensor, right: Tensor) -> float:
    """The logit of the score (M,) at which a box is as likely right (M,) as wrong, by a logistic regression.

    It lies among the logits of the scores. 0, which is the score 0.5, where nothing is known: all are right, all are
    wrong, or a higher score is not more often right.
    """
    if right.all() or not right.any():
        return 0.0
    logits, target = scores.double().logit(eps=1e-6), right.double()
    line = torch.zeros(2, dtype=torch.float64, requires_grad=True)  # slope and intercept
    optimizer = torch.optim.LBFGS([line], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = binary_cross_entropy_with_logits(line[0] * logits + line[1], target)
        value.backward()
        return value

    optimizer.step(loss)
    slope, intercept = line.detach()
    return float((-intercept / slope).clamp(logits.min(), logits.max())) if slope > 0 else 0.0
