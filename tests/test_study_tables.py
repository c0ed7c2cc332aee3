"""The tables of a study: seeds, their agreement, classes of any name."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from hvnet.studies.catalogue import STUDIES, Row, Study
from hvnet.studies.rows import Outcome
from hvnet.studies.tables import agreement, real_table, trained_table, write_csv


def outcome(row: str, seed: int, ap: float, names: Sequence[str] = ("Car", "Pedestrian", "Cyclist")) -> Outcome:
    """Two classes whose moderate BEV AP are ap - 1 and ap + 1, and one that the frames do not hold."""
    scores = {
        names[0]: {"bev": [0.0, ap - 1, 0.0], "3d": [7.0] * 3, "aos": [8.0] * 3},
        names[1]: {"bev": [90.0, ap + 1, 0.0], "3d": [7.0] * 3, "aos": [8.0] * 3},
        names[2]: {measure: [None] * 3 for measure in ("bev", "3d", "aos")},
    }
    return Outcome(Row(row, row), seed, Path(f"{row}-{seed}"), 1, 1.0, 1, "cpu", 0.0, scores)


def test_agreement_of_seeds() -> None:
    """Rows a < b < c with one seed and b < a < c with the other: two of three pairs; spreads 3, 1 and 0."""
    first = {"a": 1.0, "b": 3.0, "c": 9.0}
    second = {"a": 4.0, "b": 2.0, "c": 9.0}
    outcomes = [outcome(row, seed, values[row]) for seed, values in enumerate((first, second)) for row in "abc"]
    assert agreement(outcomes) == (2, 3, 1.0)
    assert outcomes[0].mean_ap() == 1.0
    assert outcomes[0].mean_ap(level=0) == 45.0
    shared = [each._replace(row=Row("d", "d")) for each in outcomes if each.row.name == "a"]
    assert agreement(outcomes + shared) == (2, 3, 1.0)  # a row that is another's training is no further row
    even = [outcome(row, seed, 5.0) for seed in range(2) for row in "ab"]
    assert agreement(even) == (0, 1, 0.0)  # a tie is no order
    assert agreement(outcomes[1:]) == (3, 3, 0.0)  # without a's first seed
    assert agreement([outcomes[0], outcomes[4]])[:2] == (0, 0)  # no seed that both have
    empty = outcome("a", 0, 5.0)._replace(scores={"Car": {"bev": [None] * 3}})
    assert agreement([empty])[:2] == (0, 0)


def test_every_seed_has_its_column() -> None:
    rows = (Row("a", "a"), Row("b", "b"))
    outcomes = [outcome("a", 0, 5.0), outcome("a", 1, 6.0), outcome("b", 1, 7.0)]
    times = {"a": (1.0, 1.0, 2.0), "b": (1.0, 1.0, 0.0)}
    table = trained_table(Study("", "", rows), outcomes, times, {"a", "b"})
    assert table[0].startswith("| row | mAP | seed 0 | seed 1 | Car |")
    assert table[2].startswith("| a | 5.5 | 5.0 | 6.0 | 4.5 |")
    assert table[3].startswith("| b | 7.0 | - | 7.0 | 6.0 |")
    assert table[3].endswith("| 0.50 |")


def test_real_frames_have_intervals() -> None:
    """Two seeds of a and one of b: AP 10 and 30, whose mean is 20, and 25; resample by resample b is 5 to 7 above a."""

    def real(row: str, seed: int, ap: float, *samples: float) -> Outcome:
        scores = {"Car": {"bev": [0.0, ap, 0.0], "3d": [0.0, 1.0, 0.0]}, "Cone": {"bev": [None] * 3}}
        drawn = {"Car": {"bev": list(samples), "3d": [1.0] * 3}, "Cone": {"bev": [math.nan] * 3}}
        return outcome(row, seed, 0.0)._replace(real=scores, real_samples=drawn)  # type: ignore[arg-type]

    study = Study("", "", (Row("a", "a"), Row("b", "b")))
    outcomes = [
        real("a", 0, 10.0, 5.0, 10.0, 25.0),
        real("a", 1, 30.0, 15.0, 30.0, 35.0),
        real("b", 0, 25.0, 15.0, 25.0, 37.0),
    ]
    assert real_table(study, outcomes) == [
        "| real | Car | Cone | Car 3D |",
        "| --- | ---: | ---: | ---: |",
        "| a | 20.0 [10.5, 29.5] | - | 1.0 [1.0, 1.0] |",
        "| b | 25.0 [15.5, 36.4] | - | 1.0 [1.0, 1.0] |",
    ]
    assert real_table(study, outcomes, less_first=True)[0] == "| real: less the first row | Car | Cone | Car 3D |"
    assert real_table(study, outcomes, less_first=True)[2:] == ["| b | +5.0 [5.0, 6.9] | - | +0.0 [0.0, 0.0] |"]


def test_classes_of_any_name(tmp_path: Path) -> None:
    """The first class stands for Car in the table; the CSV file has KITTI's columns and those of all others."""
    names = ("Straßenbahn", "excavator", "cone")
    own = outcome("lossless", 0, 5.0, names)
    samples = {name: {"bev": [float(k) for k in range(101)], "3d": [7.0]} for name in names}
    own = own._replace(real=own.scores, real_samples=samples, real_dropped=0.25, dropped=0.5)
    times = {"lossless": (1.0, 1.0, 2.0)}
    table = trained_table(STUDIES["density"], [own], times, {"lossless"})
    assert table[0] == (
        "| row | mAP | seed 0 | Straßenbahn | excavator | cone | Straßenbahn 3D | dropped % | real: dropped % "
        "| real: Straßenbahn | time |"
    )
    assert table[2] == "| every point | 5.0 | 5.0 | 4.0 | 6.0 | - | 7.0 | 50.0 | 25.0 | 4.0 | 1.00 |"
    write_csv(tmp_path / "a.csv", "density", [own], times, {"data": "a root"})
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert (row["Straßenbahn bev"], row["excavator bev"], row["real excavator 3d"]) == ("4.000", "6.000", "7.000")
    assert (row["real excavator bev low"], row["real excavator bev high"]) == ("2.500", "97.500")
    assert (row["cone bev"], row["Car bev"], row["data"]) == ("-", "-", "a root")
