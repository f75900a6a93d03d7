"""A depth image and the scan it was fused with in one figure, for people who tune."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from datasets.messages import Array
from fusion.depth_labels import BEHIND, FLYING, FREE, HOLE, NEAREST, PIT, TOO_HIGH
from fusion.scan import BOTH, CAMERA, LIDAR
from slam.comparison.fuse_moment import FuseMoment, RangeRows, range_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_IN, DOTS_PER_IN = (16.0, 11.2), 100
AHEAD_M, BEHIND_M, ASIDE_M = 5.2, 1.0, 5.0
"""What of the plane is shown, around the base;"""
SIDE_DEG = 6.0
"""and of the bearings, beside what the camera saw."""
HOLE_COLOUR, GREY, INK = "#f4f4f4", "#b8b8b8", "#404040"
LIDAR_COLOUR, CAMERA_COLOUR, BOTH_COLOUR = "#0072b2", "#d55e00", "#009e73"
"""Of Okabe and Ito's colours, which eyes of all kinds tell apart; the marks differ, too."""
BY_LABEL = {
    HOLE: ("hole", HOLE_COLOUR),
    TOO_HIGH: ("out of the gate", "#c4c4c4"),
    FREE: ("floor", "#ece2c6"),
    PIT: ("below the floor", "#7b3f98"),
    FLYING: ("flying", "#f0e442"),
    BEHIND: ("in the gate, not nearest", "#56b4e9"),
    NEAREST: ("nearest surface", CAMERA_COLOUR),
}
PAPER_WORDS = {TOO_HIGH: "other rows", BEHIND: "rows that count", NEAREST: "nearest in its column"}
BY_SOURCE = {
    LIDAR: ("lidar alone", LIDAR_COLOUR, ".", 26),
    BOTH: ("both", BOTH_COLOUR, "s", 16),
    CAMERA: ("camera alone", CAMERA_COLOUR, "^", 26),
}


def fuse_picture(moment: FuseMoment) -> bytes:
    """The figure as a PNG: image, used pixels and ranges above, the plane below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=SIZE_IN, dpi=DOTS_PER_IN, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 1, height_ratios=[1.0, 1.02])
    upper, lower = (figure.add_subfigure(grid[row]) for row in (0, 1))
    figure.suptitle("\n".join(moment.title()), fontsize=12)
    depth, roles, bearings = upper.subplots(1, 3)
    _depth(depth, moment)
    _roles(roles, moment)
    _bearings(bearings, moment, range_rows(moment))
    if moment.fused is None:
        _plane(lower.subplots(1, 1), moment)
    else:
        apart, together = lower.subplots(1, 2)
        _plane(apart, moment)
        _fused_plane(together, moment)
    buffer = io.BytesIO()
    # No date and no version in the file: the same moment gives the same bytes.
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _depth(axes: Axes, moment: FuseMoment) -> None:
    """Depth by colour, holes pale, and an outline around what the pseudo-laser was made of."""
    from matplotlib import colormaps  # noqa: PLC0415

    colours = colormaps["cividis_r"].with_extremes(bad=HOLE_COLOUR)
    depth_m = moment.image.depth_m
    shown = axes.imshow(depth_m, cmap=colours, vmin=0.0, vmax=_farthest_m(moment))
    below = axes.inset_axes((0.05, -0.09, 0.9, 0.035))
    colour_bar = axes.figure.colorbar(shown, cax=below, orientation="horizontal")
    colour_bar.set_label("depth, m (holes are pale)")
    used = moment.labels == NEAREST
    if moment.config.fusion == "paper":
        used |= moment.labels == BEHIND
    if used.any() and not used.all():
        axes.contour(used, levels=[0.5], colors=CAMERA_COLOUR, linewidths=0.9)
    holes = np.isnan(depth_m).mean()
    axes.set_title(f"depth image: {holes:.0%} holes, used pixels outlined", fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])


def _roles(axes: Axes, moment: FuseMoment) -> None:
    from matplotlib.colors import ListedColormap  # noqa: PLC0415
    from matplotlib.patches import Patch  # noqa: PLC0415

    paper = moment.config.fusion == "paper"
    colours = ListedColormap([colour for _, colour in BY_LABEL.values()])
    axes.imshow(moment.labels, cmap=colours, vmin=-0.5, vmax=len(BY_LABEL) - 0.5)
    shares = np.bincount(moment.labels.ravel(), minlength=len(BY_LABEL)) / moment.labels.size
    patches = [
        Patch(
            facecolor=colour,
            edgecolor=GREY,
            label=f"{PAPER_WORDS.get(label, word) if paper else word} {_percent(shares[label])}",
        )
        for label, (word, colour) in BY_LABEL.items()
        if shares[label] > 0.0
    ]
    axes.legend(
        handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2, fontsize=9
    )
    axes.set_title(f"what became of the pixels: {gate_words(moment)}", fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])


def gate_words(moment: FuseMoment) -> str:
    """Which pixels may count, by the configuration."""
    if moment.config.fusion == "paper":
        return f"{moment.config.paper.scan_height_px} rows around the middle count"
    depth = moment.config.depth
    return f"height gate {depth.lower_m:g} to {depth.upper_m:g} m, to {depth.max_range_m:g} m"


def _bearings(axes: Axes, moment: FuseMoment, rows: RangeRows) -> None:
    """Range over bearing where the camera looks, left being left."""
    centre = "lidar" if moment.sweep is not None else "camera"
    if len(rows.limits):
        bearing, low, high = rows.limits.T
        axes.vlines(np.degrees(bearing), low, high, color="#d9d9d9", linewidth=2.5, zorder=1)
        axes.plot([], [], color="#d9d9d9", linewidth=5, label="associated within")
    fused = np.column_stack([np.degrees(rows.fused[:, 0]), rows.fused[:, 1]])
    plain: dict[str, Any] = {"linestyle": "none", "markersize": 4}
    axes.plot(*_degrees(rows.lidar), ".", color=LIDAR_COLOUR, markersize=5, label="lidar", zorder=2)
    axes.plot(*_degrees(rows.camera), marker="x", color=INK, label="camera", zorder=3, **plain)
    for source in (BOTH, CAMERA):
        word, colour, mark, _ = BY_SOURCE[source]
        of = fused[rows.source == source]
        if len(of):
            axes.plot(
                *of.T,
                marker=mark,
                color=colour,
                markerfacecolor="none",
                label=f"fused: {word}",
                zorder=4,
                linestyle="none",
                markersize=6,
                markeredgewidth=0.8,
            )
    if len(rows.camera):
        bearing = np.degrees(rows.camera[:, 0])
        axes.set_xlim(float(bearing.max()) + SIDE_DEG, float(bearing.min()) - SIDE_DEG)
    axes.set_ylim(0.0, _farthest_m(moment))
    axes.set_xlabel(f"bearing around the {centre}, deg")
    axes.set_ylabel(f"range from the {centre}, m")
    axes.grid(color="#ececec")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=9)
    axes.set_title("ranges, and the association's tolerance (square on)", fontsize=10)


def _plane(axes: Axes, moment: FuseMoment) -> None:
    """The pseudo-laser with the camera's view, and the lidar's scan, before they are fused."""
    pseudo, T = moment.pseudo, moment.T_fused_view
    _frame(axes, "lidar scan and pseudo-laser, base frame" if moment.sweep else "pseudo-laser")
    origin = _moved(pseudo.origin_base[None], T)[0]
    reach_m = np.where(np.isfinite(pseudo.free_to_m), pseudo.free_to_m, 0.0)
    rays = np.column_stack([np.cos(pseudo.bearings_rad), np.sin(pseudo.bearings_rad)])
    free = _moved(pseudo.origin_base + rays * reach_m[:, None], T)
    axes.fill(
        *_drawn(np.vstack([origin, free, origin])).T, color="#e6f0fa", label="seen to be free"
    )
    far_m = _farthest_m(moment)
    for edge, word in ((rays[0], None), (rays[-1], "camera's view")):
        end = _moved((pseudo.origin_base + edge * far_m)[None], T)[0]
        axes.plot(*_drawn(np.vstack([origin, end])).T, color=GREY, linewidth=1, ls="--", label=word)
    if moment.sweep is not None:
        seen = moment.sweep.points_base[np.isfinite(moment.sweep.ranges_m)]
        _dots(axes, seen, LIDAR_COLOUR, ".", 14, "lidar")
        axes.plot(*_drawn(moment.sweep.origin_base[None]).T, "o", color=LIDAR_COLOUR, ms=6)
    points = _moved(pseudo.points_base, T)
    words = f"pseudo-laser: {len(points)} of {len(rays)} bins"
    _dots(axes, points, CAMERA_COLOUR, "x", 18, words, 0.9)
    axes.plot(*_drawn(origin[None]).T, "^", color=CAMERA_COLOUR, ms=7)
    axes.legend(fontsize=9, loc="upper left", framealpha=0.9)


def _fused_plane(axes: Axes, moment: FuseMoment) -> None:
    assert moment.fused is not None
    _frame(axes, "fused scan by source")
    fused = moment.fused
    for source, (word, colour, mark, size) in BY_SOURCE.items():
        points = fused.points_base[fused.source == source]
        _dots(axes, points, colour, mark, size, f"{word}: {len(points)}")
    axes.plot(*_drawn(fused.origin_base[None]).T, "o", color=LIDAR_COLOUR, ms=6)
    axes.legend(fontsize=9, loc="upper left", framealpha=0.9)


def _frame(axes: Axes, title: str) -> None:
    """Ahead is up, left is left, a metre is as long both ways."""
    axes.set_aspect("equal")
    axes.set_xlim(-ASIDE_M, ASIDE_M)
    axes.set_ylim(-BEHIND_M, AHEAD_M)
    ticks = np.arange(-int(ASIDE_M), int(ASIDE_M) + 1)
    axes.set_xticks(ticks, [f"{-tick:d}" for tick in ticks])
    axes.set_xlabel("left of the base, m")
    axes.set_ylabel("ahead of the base, m")
    axes.grid(color="#ececec")
    axes.set_axisbelow(True)
    axes.set_title(title, fontsize=10)


def _dots(
    axes: Axes,
    points_base: Array,
    colour: str,
    mark: str,
    size: float,
    label: str,
    line: float = 0.0,
) -> None:
    right, up = _drawn(points_base).T
    axes.scatter(right, up, s=size, color=colour, marker=mark, linewidths=line, label=label)


def _drawn(points_base: Array) -> Array:
    """(N, 2) of the figure: right and up."""
    return np.column_stack([-points_base[:, 1], points_base[:, 0]])


def _moved(points: Array, T: Array) -> Array:
    moved: Array = points @ T[:2, :2].T + T[:2, 2]
    return moved


def _degrees(rows: Array) -> tuple[Array, Array]:
    return np.degrees(rows[:, 0]), rows[:, 1]


def _farthest_m(moment: FuseMoment) -> float:
    """How far depth and ranges are shown: some more than the camera is trusted."""
    return 1.5 * moment.config.depth.max_range_m


def _percent(share: float) -> str:
    if share < 0.001:
        return "below 0.1%"
    return f"{share:.0%}" if share >= 0.01 else f"{share:.1%}"
