"""The page of mistakes: a run to make it of, and a parser that looks at its tags."""

import json
from html.parser import HTMLParser
from pathlib import Path

from tests.models import TINY, save_untrained

AVERAGES = {"R40": {"bev": [1.0, 2.0, 3.0], "3d": [0.0, 1.0, 2.0]}, "exact": {"bev": [1.0, 2.0, 3.0]}}
METRICS = [
    {"epoch": 1, "step": 2, "loss": 2.0, "classification": 1.5, "localization": 0.5},
    {"epoch": 2, "step": 4, "loss": 1.0, "classification": 0.7, "localization": 0.3,
     "validation": {"Car": AVERAGES, "Cyclist": {"R40": {"bev": [None] * 3}, "exact": {"bev": [None] * 3}}}},
]  # fmt: skip


def write_run(out: Path, root: Path) -> Path:
    """The folder of a run of an untrained detector on a KITTI root."""
    out.mkdir()
    wide = ["encoder.point_range=[0, -12.8, -3, 25.6, 12.8, 2]", "head.score_threshold=0.0"]
    save_untrained(out / "checkpoint.pt", [*TINY, *wide, "head.candidates=100", "head.detections=6"])
    (out / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in METRICS))
    (out / "data.txt").write_text(f"{root}\n")
    return out


class Page(HTMLParser):
    """The tags of a page; every one that is opened is closed again, in order."""

    VOID = ("meta", "img")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def images(self, kind: str | None) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == "img" and attributes.get("class") == kind]
