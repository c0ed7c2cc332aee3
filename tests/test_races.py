"""No kernel has a race: small versions of all that the package launches, with every thread alone (see races.py)."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest
from cuda_kernels import find_kernels

from tests.helpers import ROOT

Trees = dict[str, dict[str, dict[str, Any]]]


@pytest.fixture(scope="module")
def trees() -> Trees:
    path = os.pathsep.join((str(ROOT), str(ROOT / "bench")))
    done = subprocess.run(
        [sys.executable, "-m", "tests.races"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_only_atomic_kernels_depend_on_the_order(trees: Trees) -> None:
    faults = {name: seen["faults"] for name, seen in trees["workloads"].items() if seen["faults"]}
    assert {name for name in faults if not trees["workloads"][name]["atomics"]} == set(), faults


def test_every_kernel_was_launched_with_several_threads(trees: Trees) -> None:
    """A new kernel needs a line in the workloads of races.py."""
    seen = trees["workloads"]
    assert {each.name for each in find_kernels()} - set(seen) == set()
    assert {name for name, each in seen.items() if each["threads"] < 2 and not each["serial"]} == set()


def test_planted_races_are_found(trees: Trees) -> None:
    found = {name.partition(".")[2]: seen["faults"] for name, seen in trees["planted"].items()}
    assert found == {
        "reads_a_neighbour": ["a thread depends on what another writes"],
        "writes_one_place": ["two threads write to one place"],
        "keeps_to_itself": [],
    }
