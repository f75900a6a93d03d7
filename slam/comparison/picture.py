"""The maps of a comparison side by side: one scale, one extent, coloured by what saw it."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.trajectory import Trajectory
from slam.mapping.layers import LayeredMap
from slam.mapping.occupancy import OCCUPIED, UNKNOWN, MapConfig, Raster
from slam.mapping.scan_store import LIDAR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Kinds = npt.NDArray[np.uint8]

NOTHING, OPEN, WALL, ALONE = 0, 1, 2, 3
"""What a pixel shows: unknown, free, occupied; from ALONE on, by one lower layer alone."""
COLOURS = ("#e0e0e0", "#ffffff", "#1a1a1a", "#d55e00", "#cc79a7", "#e69f00", "#56b4e9")
WAY, START, END, INK = "#0072b2", "#009e73", "#f0e442", "#404040"
WIDTH_PX, HEIGHT_PX = 1960, 1180
"""About this large the picture is at most."""
WHOLE_FROM_PX = 3
"""Cells that are larger are shown as squares of whole pixels."""
GAP_PX, TITLE_PX, LEGEND_PX, DOTS_PER_IN = 14, 62, 64, 100
BORDER_M = 0.5
ALIKE = 0.8
"""Maps that are smaller by no more than this are shown side by side rather than in rows."""
LARGER = 1.3
"""A map that got lost may be larger than the trusted ones by this factor; then it is cut off."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One map of the picture, or why there is none.

    title, words : a line each above it. trusted : whether it says what the extent should be.
    """

    title: str
    words: str
    grid: Raster | None
    trajectory: Trajectory | None
    trusted: bool = True


class Window(NamedTuple):
    """(left, low, right, high) m, in the map frame."""

    left: float
    low: float
    right: float
    high: float


def comparison_picture(panels: Sequence[Panel], config: MapConfig) -> bytes:
    """All panels as one PNG. Raises ValueError if none of them has a map."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    grids = [panel.grid for panel in panels if panel.grid is not None]
    window = common_window(panels, config)
    cell_m = max(grid.resolution_m for grid in grids)
    columns, pixels_per_m = _layout(len(panels), window, cell_m)
    wide_px = round((window.right - window.left) * pixels_per_m)
    high_px = round((window.high - window.low) * pixels_per_m)
    rows = math.ceil(len(panels) / columns)
    full_w = GAP_PX + columns * (wide_px + GAP_PX)
    full_h = rows * (TITLE_PX + high_px + GAP_PX) + LEGEND_PX
    figure = Figure(figsize=(full_w / DOTS_PER_IN, full_h / DOTS_PER_IN), dpi=DOTS_PER_IN)
    FigureCanvasAgg(figure)
    layers: list[str] = []
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        left = GAP_PX + column * (wide_px + GAP_PX)
        low = full_h - (row + 1) * (TITLE_PX + high_px + GAP_PX) + GAP_PX
        box = (left / full_w, low / full_h, wide_px / full_w, high_px / full_h)
        axes = figure.add_axes(box)
        _draw(axes, panel, window, config, (high_px, wide_px))
        for layer in lower_layers(panel.grid):
            if layer not in layers:
                layers.append(layer)
    _legend(figure, layers, pixels_per_m, full_w, full_h)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def common_window(panels: Sequence[Panel], config: MapConfig) -> Window:
    """What is known in the trusted maps, and in the others as long as that is not much more.

    Raises ValueError if there is no map.
    """
    boxes = [(panel, _known(panel, config)) for panel in panels if panel.grid is not None]
    if not boxes:
        raise ValueError("no panel has a map")
    inner = _around([box for panel, box in boxes if panel.trusted] or [box for _, box in boxes])
    outer = _around([box for _, box in boxes])
    larger = [(outer[k + 2] - outer[k]) / (inner[k + 2] - inner[k]) for k in (0, 1)]
    return Window(*(inner if max(larger) > LARGER else outer))


def lower_layers(grid: Raster | None) -> list[str]:
    """The layers of a map besides that of the highest lidar, by name; none of a single grid."""
    if not isinstance(grid, LayeredMap) or len(grid.layers) < 2:
        return []
    lidars = [name for name in grid.layers if name == LIDAR or name.startswith(f"{LIDAR} ")]
    highest = lidars[-1] if lidars else next(iter(grid.layers))
    return [name for name in grid.layers if name != highest]


def kinds_of(grid: Raster, config: MapConfig) -> Kinds:
    """(height, width) NOTHING, OPEN, WALL, or ALONE + k where the k-th lower layer alone says so.

    Alone means that no cell of the highest lidar's layer beside it is occupied.
    """
    import cv2  # noqa: PLC0415

    kinds = np.array([NOTHING, OPEN, WALL], np.uint8)[grid.classes(config)]
    lower = lower_layers(grid)
    if lower:
        assert isinstance(grid, LayeredMap)
        rest = next(name for name in grid.layers if name not in lower)
        walls = (grid.layers[rest].classes(config) == OCCUPIED).astype(np.uint8)
        beside = cv2.dilate(walls, np.ones((3, 3))) > 0
        for k, name in reversed(list(enumerate(lower))):
            alone = (grid.layers[name].classes(config) == OCCUPIED) & ~beside
            kinds[alone] = ALONE + min(k, len(COLOURS) - ALONE - 1)
    return kinds


def pixels_of(grid: Raster, kinds: Kinds, window: Window, shape: tuple[int, int]) -> Kinds:
    """(height, width) in pixels, row 0 on top: of all cells in a pixel the highest kind.

    Where pixels are smaller than cells, each shows the cell that it lies in.
    """
    (rows, row_of), (columns, column_of) = (
        _spans(shape[0], window.low, window.high, grid.corner_map_m[1], grid.resolution_m),
        _spans(shape[1], window.left, window.right, grid.corner_map_m[0], grid.resolution_m),
    )
    out = np.zeros(shape, np.uint8)
    for down in range(rows):
        for across in range(columns):
            i, j = row_of[:, down][::-1], column_of[:, across]
            inside = ((i >= 0) & (i < grid.shape[0]))[:, None] & ((j >= 0) & (j < grid.shape[1]))
            picked = kinds[np.clip(i, 0, grid.shape[0] - 1)][:, np.clip(j, 0, grid.shape[1] - 1)]
            np.maximum(out, np.where(inside, picked, NOTHING), out=out)
    return out


def _spans(
    count: int, low_m: float, high_m: float, corner_m: float, cell_m: float
) -> tuple[int, npt.NDArray[np.int64]]:
    """(most cells in a pixel, (count, that) the cells of each pixel) along one axis."""
    edges = (np.linspace(low_m, high_m, count + 1) - corner_m) / cell_m
    first = np.floor(edges[:-1] + 1e-6).astype(np.int64)
    last = np.maximum(np.ceil(edges[1:] - 1e-6).astype(np.int64) - 1, first)
    most = int((last - first).max()) + 1
    if edges[1] - edges[0] <= 1.0:
        middle = np.floor(0.5 * (edges[:-1] + edges[1:])).astype(np.int64)
        return 1, middle[:, None]
    return most, np.minimum(first[:, None] + np.arange(most), last[:, None])


def _known(panel: Panel, config: MapConfig) -> Array:
    """(4,) left, low, right, high of what a map knows, and of the way."""
    grid = panel.grid
    assert grid is not None
    rows, columns = np.nonzero(grid.classes(config) != UNKNOWN)
    pieces = [np.array(grid.corner_map_m) + np.array([[0.0, 0.0]])]
    if rows.size:
        cells = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
        pieces = [np.array(grid.corner_map_m) + cells * grid.resolution_m]
    if panel.trajectory is not None:
        pieces.append(panel.trajectory.xyyaw[:, :2])
    points = np.concatenate(pieces)
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def _is_cut(panel: Panel, window: Window, config: MapConfig) -> bool:
    if panel.grid is None:
        return False
    left, low, right, high = _known(panel, config).tolist()
    beyond_m = (window.left - left, window.low - low, right - window.right, high - window.high)
    return max(beyond_m) > BORDER_M


def _around(boxes: Sequence[Array]) -> tuple[float, float, float, float]:
    stacked = np.array(boxes)
    left, low = (stacked[:, :2].min(axis=0) - BORDER_M).tolist()
    right, high = (stacked[:, 2:].max(axis=0) + BORDER_M).tolist()
    return left, low, right, high


def _layout(count: int, window: Window, cell_m: float) -> tuple[int, float]:
    """(columns, pixels per metre) that show the maps largest; whole pixels to a cell if they can.

    Side by side is what one compares best; but no more columns than the rows need.
    """
    wide_m, high_m = window.right - window.left, window.high - window.low

    def scale(columns: int) -> float:
        rows = math.ceil(count / columns)
        across = (WIDTH_PX - (columns + 1) * GAP_PX) / columns / wide_m
        down = (HEIGHT_PX - LEGEND_PX - rows * (TITLE_PX + GAP_PX)) / rows / high_m
        return max(min(across, down), 1.0)

    best = max(scale(n) for n in range(1, count + 1))
    columns = max(n for n in range(1, count + 1) if scale(n) >= ALIKE * best)
    columns = math.ceil(count / math.ceil(count / columns))
    per_cell = scale(columns) * cell_m
    whole = math.floor(per_cell) / cell_m if per_cell >= WHOLE_FROM_PX else scale(columns)
    return columns, whole


def _draw(
    axes: Axes,
    panel: Panel,
    window: Window,
    config: MapConfig,
    shape: tuple[int, int],
) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    words = panel.words if panel.grid is not None else "no map"
    if _is_cut(panel, window, config):
        words = f"cut off, it is larger; {words}"
    words = textwrap.shorten(words, max(18, shape[1] // 7), placeholder=" ...")
    above: dict[str, Any] = {
        "xycoords": "axes fraction",
        "textcoords": "offset points",
        "va": "baseline",
    }
    axes.annotate(panel.title, (0, 1), (0, 23), fontsize=13, fontweight="bold", **above)
    axes.annotate(words, (0, 1), (0, 7), fontsize=10, **above)
    if panel.grid is None:
        axes.set_facecolor(COLOURS[NOTHING])
        text = textwrap.fill(panel.words, max(18, shape[1] // 10))
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=11)
        return
    from matplotlib.colors import to_rgb  # noqa: PLC0415

    palette = np.array([to_rgb(colour) for colour in COLOURS])
    kinds = pixels_of(panel.grid, kinds_of(panel.grid, config), window, shape)
    extent = (window.left, window.right, window.low, window.high)
    axes.imshow(palette[kinds], extent=extent, interpolation="none", aspect="auto")
    axes.set_xlim(window.left, window.right)
    axes.set_ylim(window.low, window.high)
    if panel.trajectory is not None:
        xy = panel.trajectory.xyyaw[:, :2]
        axes.plot(*xy.T, color=WAY, linewidth=1.3)
        axes.plot(*xy[0], "o", color=START, markersize=11, markeredgecolor=INK)
        axes.plot(*xy[-1], "s", color=END, markersize=6, markeredgecolor=INK)


def _legend(
    figure: Figure, layers: Sequence[str], pixels_per_m: float, full_w: int, full_h: int
) -> None:
    """Colours and marks in one strip, with a scale bar at its left."""
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    strip = figure.add_axes((0.0, 0.0, 1.0, LEGEND_PX / full_h))
    strip.set_axis_off()
    strip.set_xlim(0, full_w)
    strip.set_ylim(0, LEGEND_PX)
    length_m = _round_m(0.16 * full_w / pixels_per_m)
    right = GAP_PX + length_m * pixels_per_m
    strip.plot([GAP_PX, right], [40, 40], color=INK, linewidth=3, solid_capstyle="butt")
    strip.text(GAP_PX, 12, f"{length_m:g} m", fontsize=11, color=INK)
    colours = zip(layers, COLOURS[ALONE:], strict=False)
    handles = [
        Patch(facecolor=COLOURS[WALL], label="occupied"),
        *(Patch(facecolor=colour, label=f"by {name} alone") for name, colour in colours),
        Patch(facecolor=COLOURS[OPEN], edgecolor=INK, label="free"),
        Patch(facecolor=COLOURS[NOTHING], edgecolor=INK, label="unknown"),
        Line2D([], [], color=WAY, label="way driven"),
        Line2D([], [], color=START, marker="o", ls="none", markeredgecolor=INK, label="start"),
        Line2D([], [], color=END, marker="s", ls="none", markeredgecolor=INK, label="end"),
    ]
    columns = len(handles) if full_w > 1500 else math.ceil(len(handles) / 2)
    strip.legend(
        handles=handles, loc="center right", ncols=columns, fontsize=11, frameon=False,
        columnspacing=1.4, handletextpad=0.5,
    )  # fmt: skip


def _round_m(length_m: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length_m * (1 + 1e-9))
