"""The viewer's page: clouds, labels and detections in the browser.

The page is viser's (the extra `view`): this process serves it, and answers its buttons, keys and sliders.
"""

import contextlib
import html
import itertools
import math
import socket
import threading
import time
from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb
from numpy.typing import NDArray
from torch import Tensor

from hvnet.boxes import EDGES, box_corners
from hvnet.data.frame import Frame, Frames, check_names, frame_at, object_names
from hvnet.evaluation.mistakes import MISS, Mistake, find_mistakes, worst
from hvnet.evaluation.rules import Rule, config_rules
from hvnet.evaluation.scoring import detect_frame
from hvnet.exceptions import InputError
from hvnet.kernels.voxel import Grid, voxel_index
from hvnet.network.detector import Detector, turned
from hvnet.network.encoder import HybridVoxelEncoder
from hvnet.network.model import Detections
from hvnet.network.pillars import PillarEncoder
from hvnet.pictures.clouds import CLASS_COLOURS, SHOWN_SCORE, TRUTH_COLOUR

with contextlib.suppress(ImportError):  # the extra `view`; only the page needs it
    import rich
    import viser

Bytes = NDArray[np.uint8]

LISTED = 8
"""Misses, and as many false positives, that the page lists."""
CHOSEN_COLOUR = "#ffffff"
REFLECTANCE = 0.6
"""Reflectance shown in the brightest colour: little in KITTI's files is above it."""
MAX_COUNTED = 100
"""Points in a voxel that is shown in the brightest colour."""
START = (-6.0, 0.0, 7.0), (20.0, 0.0, -2.0)
"""Where the camera starts and what it looks at, LiDAR axes: from behind and above, over the sensor."""
NOTHING = Detections(torch.zeros(0, 7), torch.zeros(0), torch.zeros(0, dtype=torch.int64))


def shades(values: NDArray[np.floating], low: float, high: float) -> Bytes:
    """Colours (N, 3) of values (N,): viridis from low, dark, to high, bright."""
    return colormaps["viridis"](np.clip((values - low) / (high - low), 0, 1), bytes=True)[:, :3]


def brighter(colour: str) -> str:
    """A colour #rrggbb of the pictures, which are white, as it is seen on the page's dark ground."""
    red, green, blue = to_rgb(colour)
    return to_hex((0.3 + 0.7 * red, 0.3 + 0.7 * green, 0.3 + 0.7 * blue))


def box_lines(boxes: Tensor) -> NDArray[np.float32]:
    """Lines (M, 13, 2, 3) of boxes (M, 7): twelve edges, and from the middle of the top to the middle of its front."""
    corners = box_corners(boxes).numpy()  # (M, 8, 3)
    heading = np.stack((corners[:, 4:].mean(axis=1), corners[:, 4:6].mean(axis=1)), axis=1)
    return np.concatenate((corners[:, EDGES], heading[:, None]), axis=1)


def grids_of(encoder: HybridVoxelEncoder | PillarEncoder) -> tuple[list[Grid], list[Grid]]:
    """The grids of an encoder's features and of its pseudo-images; pillars have one for both."""
    if isinstance(encoder, PillarEncoder):
        return [encoder.grid], [encoder.grid]
    return encoder.feature_grids, encoder.projection_grids


def points_per_voxel(points: Tensor, grid: Grid) -> Tensor:
    """How many of the points (N, 4) are in each one's voxel: (N,) int64, 0 for a point outside the range."""
    index = voxel_index(points, torch.zeros(len(points), dtype=torch.int64), 1, [grid])
    voxel = index.scales[0].segments.voxel
    counts = torch.zeros(len(points), dtype=torch.int64)
    counts[index.order] = torch.bincount(voxel)[voxel]
    return counts


def norm_image(image: Tensor) -> Bytes:
    """RGBA (N_W, N_L, 4) of the channel norm of a pseudo-image (C, N_L, N_W): x to the right, y down, 0 is clear."""
    norm = torch.linalg.vector_norm(image.float(), dim=0).T.cpu().numpy()
    filled = norm > 0
    high = np.percentile(norm[filled], 99) if filled.any() else 1.0
    colours = colormaps["magma"](np.clip(0.2 + 0.8 * norm / high, 0, 1), bytes=True)
    colours[~filled, 3] = 0
    return colours


def ground_height(points: Tensor) -> float:
    """A height in metres that few of the points (N, 4) are below; 0 where there is none."""
    return float(np.percentile(points[:, 2].numpy(), 1)) if len(points) else 0.0


def camera_for(box: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where a camera is placed and looks to show a box (7,): 10 m from it on the sensor's side, and 6 m above it."""
    centre = box[:3].double().numpy()
    distance = np.linalg.norm(centre[:2])
    away = centre[:2] / distance if distance > 0 else np.array([1.0, 0.0])
    return centre + np.array([*(-10 * away), 6.0]), centre


def mistake_line(mistake: Mistake) -> str:
    """A mistake in a few words: how bad it is, and where."""
    degree = f"{mistake.points} points" if mistake.kind == MISS else f"score {mistake.score:.2f}"
    return f"{mistake.name}, {degree}, {mistake.distance:.0f} m, {mistake.frame}"


def paragraph(*lines: str) -> str:
    """HTML of lines of text, as small as the labels of the controls."""
    text = "<br>".join(html.escape(line) for line in lines)
    return f'<div style="font-size: 0.8em; padding: 0.2em 1em">{text}</div>'


def legend(colours: Mapping[str, str]) -> str:
    """HTML of what the colours of boxes mean."""
    parts = [f'<span style="color: {colour}">■</span> {html.escape(name)}' for name, colour in colours.items()]
    return f'<div style="font-size: 0.8em; padding: 0.2em 1em">{" &nbsp; ".join(parts)}</div>'


class Viewer:
    """The page: its controls, the frame that it shows, and what was found in the frames so far.

    Callbacks come from several threads. One at a time has the lock: a detector is not made for more.
    """

    def __init__(
        self, server: "viser.ViserServer", detector: Detector, frames: Frames, rules: Mapping[str, Rule] | None = None
    ) -> None:
        """Shows the first of the frames. Raises InputError if it cannot be read, or for a name used twice.

        rules: what a detection of a class has to reach; by default those of the detector's config.
        """
        check_names(frames)
        self.server, self.detector, self.frames = server, detector, frames
        self.rules = rules or config_rules(detector.config)
        self.lock = threading.RLock()
        self.wanted = 0  # the frame that was asked for last
        self.frame, self.detections = Frame("", torch.zeros(0, 4)), NOTHING  # what is shown
        self.look = detector.look(self.frame.points)
        self.texts: list[tuple[viser.LabelHandle, float]] = []  # of every box of this frame, and its score
        self.found: dict[int, Detections] = {}  # of every frame that was examined
        self.mistakes: dict[int, list[Mistake]] = {}  # of every labelled frame that was examined
        self.listed: tuple[list[Mistake], list[Mistake]] = [], []

        feature_grids, projection_grids = grids_of(detector.encoder)
        self.voxels = {f"points in its {grid.cell[0]:g} m voxel": grid for grid in feature_grids}
        self.images = {f"{grid.cell[0]:g} m": grid for grid in projection_grids}
        self.colours = dict(zip(detector.classes, itertools.cycle(map(brighter, CLASS_COLOURS)), strict=False))

        server.initial_camera.position, server.initial_camera.look_at = START
        server.initial_camera.fov = math.radians(55)
        gui, lowest = server.gui, detector.config.head.score_threshold
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self.chooser = gui.add_dropdown("frame", list(frames.names))
        turn = gui.add_button_group("", ("previous (p)", "next (n)"))
        self.score = gui.add_slider("score", min=lowest, max=1, step=0.01, initial_value=max(lowest, SHOWN_SCORE))
        self.colour = gui.add_dropdown("colour", ("height", "reflectance", *self.voxels))
        self.overlay = gui.add_dropdown("pseudo-image", ("off", *self.images))
        self.named = gui.add_checkbox("names", True)
        gui.add_html(legend({"labelled": brighter(TRUTH_COLOUR)} | self.colours))
        self.info = gui.add_html("")
        self.folders = [gui.add_folder(f"worst {kind}", visible=False) for kind in ("misses", "false positives")]
        with self.folders[0]:
            misses = [gui.add_button("", visible=False) for _ in range(LISTED)]
        with self.folders[1]:
            false_positives = [gui.add_button("", visible=False) for _ in range(LISTED)]
        self.buttons = misses, false_positives
        self.progress = gui.add_html("")
        self.camera = gui.add_panel(visible=False)
        with self.camera.add_tab("camera"):
            self.picture = gui.add_image(np.zeros((1, 1, 3), np.uint8))
        self.camera.float(x=15, y=-15, width=520)

        gui.add_command("previous frame", hotkey="P").on_trigger(lambda _: self.go(self.wanted - 1))
        gui.add_command("next frame", hotkey="N").on_trigger(lambda _: self.go(self.wanted + 1))
        turn.on_click(lambda event: self.go(self.wanted + (1 if event.target.value == "next (n)" else -1)))
        self.chooser.on_update(self.choose)
        self.score.on_update(lambda _: self.draw_boxes())
        self.named.on_update(lambda _: self.draw_boxes())
        self.colour.on_update(lambda _: self.draw_points())
        self.overlay.on_update(lambda _: self.draw_overlay())
        for kind, column in enumerate(self.buttons):
            for row, button in enumerate(column):
                button.on_click(partial(self.press, kind, row))
        self.show(*self.examine(0))

    def examine(self, index: int) -> tuple[Frame, Detections]:
        """A frame and what is detected in it, whose mistakes are noted. Raises InputError."""
        with self.lock:
            frame = frame_at(self.frames, index)
            if index not in self.found:
                self.found[index] = detect_frame(self.detector, frame)
                if frame.objects is not None:
                    self.mistakes[index] = find_mistakes(frame, self.found[index], self.rules, SHOWN_SCORE)
            return frame, self.found[index]

    def search(self) -> None:
        """Examines the frames with labels, one after the other, while the page is in use; lists the worst mistakes."""
        unread = unlabelled = 0

        def notes(searched: int) -> list[str]:
            lines = [f"{searched} of {len(self.frames)} frames searched at score {SHOWN_SCORE}"]
            lines += [f"{unlabelled} have no labels"] * (unlabelled > 0)
            return lines + [f"{unread} cannot be read"] * (unread > 0)

        for index in range(len(self.frames)):
            if index not in self.mistakes:
                try:
                    if object_names(self.frames, index) is None:
                        unlabelled += 1
                        continue
                    self.examine(index)
                except (InputError, OSError):  # the page says what is wrong where the frame is chosen
                    unread += 1
                time.sleep(0.01)  # lets a callback that waits have the lock
            self.list_mistakes(*notes(index + 1))
        self.list_mistakes(*notes(len(self.frames)))
        if unlabelled == len(self.frames):
            self.progress.content = paragraph("no labels, so that no mistakes are known")

    def list_mistakes(self, *notes: str) -> None:
        """Writes the worst of the mistakes known so far on the buttons, and some notes below."""
        with self.lock, self.server.atomic():
            for folder in self.folders:
                folder.visible = bool(self.mistakes)
            self.listed = worst((mistake for part in self.mistakes.values() for mistake in part), LISTED)
            for column, mistakes in zip(self.buttons, self.listed, strict=True):
                for button, mistake in zip(column, mistakes, strict=False):
                    button.label, button.visible = mistake_line(mistake), True
            self.progress.content = paragraph(*notes)

    def go(self, index: int) -> None:
        """Shows a frame; the last one, if they are asked for faster than they come."""
        index %= len(self.frames)
        self.wanted = index
        with self.lock:
            if index == self.wanted:
                try:
                    self.show(*self.examine(index))
                except (InputError, OSError) as error:
                    self.show(Frame(self.frames.names[index], torch.zeros(0, 4), notes=[str(error)]), NOTHING)

    def choose(self, event: "viser.GuiEvent[viser.GuiDropdownHandle[str]]") -> None:
        """Shows the frame that a user chose; the chooser also follows frames that were reached in another way."""
        if event.client is not None:
            self.go(self.chooser.options.index(self.chooser.value))

    def press(self, kind: int, row: int, event: "viser.GuiEvent[viser.GuiButtonHandle]") -> None:
        """Jumps to a row of the misses (kind 0) or of the false positives (1)."""
        self.jump(self.listed[kind][row], event.client)

    def jump(self, mistake: Mistake, client: "viser.ClientHandle | None") -> None:
        """Shows a mistake: its frame, a mark around it, and the client's camera before it."""
        with self.lock:
            self.go(self.chooser.options.index(mistake.frame))
            around = mistake.box.clone()
            around[3:6] += 0.4
            self.lines("/chosen", around[None], CHOSEN_COLOUR, 2)
            if client is not None:
                with client.atomic():
                    client.camera.position, client.camera.look_at = camera_for(mistake.box)

    def show(self, frame: Frame, found: Detections) -> None:
        """Draws a frame. Raises InputError if its image cannot be read."""
        image = frame.camera.read_image() if frame.camera is not None else None
        self.frame, self.detections, self.look = frame, found, self.detector.look(frame.points)
        truth, names = (NOTHING.boxes, ()) if frame.objects is None else (frame.objects.boxes, frame.objects.names)
        with self.server.atomic():
            self.chooser.value = frame.name  # type: ignore[misc]  # mypy misses viser's setter
            self.server.scene.remove_by_name("/chosen")
            for text, _ in self.texts:
                text.remove()
            self.texts = [(self.text(f"/labelled/{k}", name, truth[k], -1), math.inf) for k, name in enumerate(names)]
            for k, (score, label) in enumerate(zip(found.scores.tolist(), found.labels.tolist(), strict=True)):
                title = f"{self.detector.classes[label]} {score:.2f}"
                self.texts.append((self.text(f"/detected/{k}", title, found.boxes[k], 1), score))
            self.lines("/truth", truth, brighter(TRUTH_COLOUR), 3)
            self.camera.visible = image is not None
            if image is not None:
                self.picture.image = image
            self.draw_points()
            self.draw_overlay()
            self.draw_boxes()

    def draw_points(self) -> None:
        """Draws the cloud in the colours that are chosen."""
        with self.lock:
            points, chosen = self.frame.points, self.colour.value
            if chosen == "height":
                z_min, z_max = self.detector.seen_range(self.look.shift)[2::3]
                colours = shades(points[:, 2].numpy(), z_min, min(z_max, z_min + 4))
            elif chosen == "reflectance":
                colours = shades(points[:, 3].numpy(), 0, REFLECTANCE)
            else:
                counts = points_per_voxel(points, self.voxels[chosen])
                colours = shades(counts.clamp(min=1).log().numpy(), 0, math.log(MAX_COUNTED))
            self.server.scene.add_point_cloud(
                "/points", points[:, :3].numpy(), colours, point_size=0.04, point_shading="flat", precision="float32"
            )

    def draw_boxes(self) -> None:
        """Draws the detections that the slider lets through, and says how many there are."""
        with self.lock, self.server.atomic():
            shown = self.detections.select(self.detections.scores >= self.score.value)
            for label, (name, colour) in enumerate(self.colours.items()):
                self.lines(f"/detections/{name}", shown.boxes[shown.labels == label], colour, 2)
            for text, score in self.texts:
                text.visible = self.named.value and score >= self.score.value
            counts = [
                f"{len(self.frame.points):,} points",
                f"{len(shown.boxes)} of {len(self.detections.boxes)} detections",
            ]
            if self.frame.objects is not None:
                counts.append(f"{len(self.frame.objects.boxes)} labelled")
            seen = [self.look.text()] * (self.look.points > 0) + [f"few are in range: {self.look.reason}"] * bool(
                self.look.reason
            )
            self.info.content = paragraph(", ".join(counts), *seen, *self.frame.notes)

    def draw_overlay(self) -> None:
        """Lays the pseudo-image that is chosen on the ground."""
        with self.lock:
            self.server.scene.remove_by_name("/pseudo-image")
            if self.overlay.value == "off":
                return
            level = list(self.images).index(self.overlay.value)
            grid = self.images[self.overlay.value]
            points, angle = self.detector.place(self.frame.points).clouds[0], self.detector.turns[0]
            sample = torch.zeros(len(points), dtype=torch.int64, device=points.device)
            picture = norm_image(self.detector.encode(points, sample, 1)[level][0])
            sharp = max(1, 1024 // max(grid.shape))  # a browser smooths what it enlarges
            length, width = (cells * cell for cells, cell in zip(grid.shape, grid.cell, strict=True))
            centre = torch.tensor([[grid.x_min + length / 2, grid.y_min + width / 2]])
            x, y = turned(centre, -angle)[0].tolist()  # back to the cloud's own axes
            self.server.scene.add_image(
                "/pseudo-image",
                picture.repeat(sharp, axis=0).repeat(sharp, axis=1),
                length,
                width,
                wxyz=(math.cos(angle / 2), 0, 0, -math.sin(angle / 2)),
                position=(x, y, ground_height(self.frame.points)),
            )

    def lines(self, name: str, boxes: Tensor, colour: str, pixels: float) -> None:
        """Draws boxes (M, 7) with lines of a width in pixels."""
        # one colour a call: viser brightens colours that are given for each line
        self.server.scene.add_line_segments(
            name, box_lines(boxes).reshape(-1, 2, 3), to_rgb(colour), thickness=pixels, thickness_units="screen"
        )

    def text(self, name: str, text: str, box: Tensor, side: int) -> "viser.LabelHandle":
        """Writes above (1) or below (-1) a box (7,)."""
        x, y, z, height = box[[0, 1, 2, 5]].tolist()
        return self.server.scene.add_label(
            name,
            text,
            position=(x, y, z + side * height / 2),
            anchor="bottom-center" if side > 0 else "top-center",
            font_screen_scale=0.75,
        )


def start_server(host: str, port: int) -> "viser.ViserServer":
    """The page's server, on this port or the next that is free. Raises InputError."""
    if not 0 <= port < 2**16:
        raise InputError(f"--port {port}: want 0 to 65535")
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise InputError(f"--host {host}: this machine has no such address ({error}); try 127.0.0.1") from error
    rich.reconfigure(quiet=True)  # which viser reports with
    return viser.ViserServer(host, port, label="HVNet", verbose=False)
