"""The bridge from torch to Warp: streams and devices of a launch, on stand-ins for CUDA's; strides that fit."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp

from hvnet.kernels import launch


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """What a launch on CUDA asks for, in its order."""
    made: list[tuple[str, Any]] = []

    class Guard:
        def __init__(self, device: torch.device) -> None:
            self.device = device

        def __enter__(self) -> None:
            made.append(("enter", self.device))

        def __exit__(self, *_: object) -> None:
            made.append(("leave", self.device))

    def stream(device: str, cuda_stream: int) -> str:
        made.append(("stream", (device, cuda_stream)))
        return f"{device}/{cuda_stream}"

    launch._warp_stream.cache_clear()
    monkeypatch.setattr(torch.cuda, "device", Guard)
    monkeypatch.setattr(wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(wp, "Stream", stream)
    monkeypatch.setattr(wp, "launch", lambda kernel, **options: made.append(("launch", options["stream"])))
    yield made
    launch._warp_stream.cache_clear()


def current(monkeypatch: pytest.MonkeyPatch, index: int, handle: int) -> None:
    stream = SimpleNamespace(device_index=index, cuda_stream=handle)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: stream)


def test_a_launch_guards_its_device(calls: list[tuple[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    device = torch.device("cuda:1")
    current(monkeypatch, 1, 7)
    launch.launch(None, 1, [], device)  # type: ignore[arg-type]
    names = [name for name, _ in calls]
    assert names.index("enter") < names.index("launch") < names.index("leave")
    assert dict(calls)["enter"] == dict(calls)["leave"] == device
    assert dict(calls)["launch"] == "cuda:1/7"


def test_a_stream_is_made_once(calls: list[tuple[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = [("cuda:0", 0), ("cuda:0", 7), ("cuda:0", 0), ("cuda:1", 0), ("cuda:0", 7)]
    for name, handle in wanted:
        current(monkeypatch, int(name[-1]), handle)
        assert launch.current_stream(torch.device(name)) == f"{name}/{handle}"
    assert [made for name, made in calls if name == "stream"] == list(dict.fromkeys(wanted))


def test_where_warp_sees_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    with pytest.raises(RuntimeError, match="Warp"):
        launch.launch(None, 1, [], torch.device("cuda:0"))  # type: ignore[arg-type]


def test_strides_of_2_gib_are_refused() -> None:
    """Warp keeps strides as int32. The tensors have no memory."""
    launch.array(torch.empty(2, 2**29 - 1, device="meta"))
    launch.array(torch.empty(2**31, device="meta"))  # one number after the other
    for shape in ((2, 2**29), (3, 2**27, 4)):
        with pytest.raises(ValueError, match="2 GiB apart; split the batch"):
            launch.array(torch.empty(shape, device="meta"))
