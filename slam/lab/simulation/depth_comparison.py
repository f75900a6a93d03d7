"""Simulated depth images beside real ones: a table for `docs/simulation.md`, and a picture.

    python -m slam.lab.simulation.depth_comparison FOLDER [--picture FILE]

FOLDER holds depth images of a D435 at 640 x 480 (PNG, 16 bit, mm). The simulated camera is in the
place ``office``, held as the real one was in its lab. The rooms differ: the table compares cameras,
not what they look at.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from datasets.errors import InputError
from datasets.messages import Array
from datasets.simulation.depth_camera import DepthModel, simulate_depth, to_millimetres
from datasets.simulation.depth_kernels import Float32s
from datasets.simulation.place import load_place
from datasets.simulation.scene import Scene
from slam.lab.simulation.depth_statistics import (
    correlation,
    left_band,
    plane_patches,
    quantum_px,
    steps,
)

REAL_FOCAL_BASELINE = 383.8 * 0.05
HEIGHT_M, DOWN_DEG, ROLL_DEG = 0.62, 19.0, 10.0
DISTANCES_M = ((0.5, 1.0), (1.0, 1.5), (1.5, 2.5), (2.5, 3.5), (3.5, 4.5), (4.5, 6.0))
JUMPS_PX = ((3.0, 6.0), (6.0, 12.0), (12.0, 25.0))
IMAGES = 20
SHOWN = {"real": (0, 7, 14), "simulated": (4, 12, 17)}
"""Which images are in the picture: those with things in them."""
SHOWN_TO_M = 5.0


def read_real(folder: Path) -> list[Float32s]:
    """``IMAGES`` of a folder, evenly, in m. Raises InputError if it has none."""
    import cv2  # noqa: PLC0415

    paths = sorted(folder.glob("*.png"))
    if not paths:
        raise InputError(
            "there is no PNG", where=str(folder), remedy="Give a folder of depth images in mm."
        )
    images = [
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        for path in paths[:: max(1, len(paths) // IMAGES)]
    ]
    return [np.asarray(image, dtype=np.float32) / np.float32(1000.0) for image in images]


def simulate(model: DepthModel, seed: int = 1) -> list[Float32s]:
    """``IMAGES`` along the tour of the office, rounded to mm, in m."""
    place = load_place("office")
    scene, rng = Scene(place), np.random.default_rng(seed)
    images = []
    for index, pose in enumerate(_poses(place.drives["tour"].way_points)):
        depth_m = simulate_depth(scene, pose, model, rng, 3.0 * index)
        images.append((to_millimetres(depth_m) / 1000.0).astype(np.float32))
    return images


def _poses(way_points: Array) -> Iterator[Array]:
    """T_map_camera evenly along a way, looking ahead and to both sides in turn."""
    legs = np.diff(way_points, axis=0)
    ends_m = np.cumsum(np.hypot(legs[:, 0], legs[:, 1]))
    for index in range(IMAGES):
        at_m = ends_m[-1] * (index + 0.5) / IMAGES
        leg = int(np.searchsorted(ends_m, at_m))
        back = (ends_m[leg] - at_m) / np.hypot(*legs[leg])
        yaw = math.atan2(legs[leg, 1], legs[leg, 0]) + (0.0, 0.7, -0.7)[index % 3]
        T_map_camera = np.eye(4)
        T_map_camera[:3, :3] = _turned(yaw, math.radians(DOWN_DEG), math.radians(ROLL_DEG))
        T_map_camera[:3, 3] = [*(way_points[leg + 1] - back * legs[leg]), HEIGHT_M]
        yield T_map_camera


def _turned(yaw: float, down: float, roll: float) -> Array:
    """Rotation from the optical frame to the map's; roll about the view, clockwise if positive."""
    cy, sy, cd, sd = math.cos(yaw), math.sin(yaw), math.cos(down), math.sin(down)
    cr, sr = math.cos(roll), math.sin(roll)
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cd, 0.0, sd], [0.0, 1.0, 0.0], [-sd, 0.0, cd]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return np.asarray(about_z @ about_y @ about_x @ optical)


def measured(images: Sequence[Float32s], focal_baseline: float) -> dict[str, str]:
    """What the table says of some images, by its row."""
    rows = {
        "holes, % of the image": f"{100 * np.mean([image == 0 for image in images]):.1f}",
        "the same without the left tenth": f"{100 * np.mean([i[:, 64:] == 0 for i in images]):.1f}",
        "band at the left, wider than the disparity by, px": _spread(
            np.concatenate([left_band(image, focal_baseline) for image in images])
        ),
        "step of the disparity, in 1/32 px": (
            f"{32 * np.nanmedian([quantum_px(image, focal_baseline) for image in images]):.2f}"
        ),
    }
    for size in (16, 48):
        patches = [plane_patches(image, focal_baseline, size) for image in images]
        depth_m = np.concatenate([each.depth_m for each in patches])
        rms_px = np.concatenate([each.rms_px for each in patches])
        for low, high in DISTANCES_M:
            at = (depth_m >= low) & (depth_m < high)
            label = f"noise on planes, {size} px wide, at {low}-{high} m, px"
            rows[label] = _spread(rms_px[at], 3) if at.sum() >= 10 else "-"
    holes = np.concatenate([each.holes for each in patches])
    near = np.concatenate([each.residuals for each in patches])[depth_m < 2.5]
    rows["holes within these, %"] = f"{100 * holes.mean():.2f}"
    for axis, name in ((1, "beside"), (0, "below")):
        found = [f"{correlation(near, lag, axis):.2f}" for lag in (2, 4, 8)]
        rows[f"correlation of noise 2, 4, 8 px {name}, to 2.5 m"] = ", ".join(found)
    rows |= _seams(np.vstack([steps(image, focal_baseline) for image in images]))
    return rows


def _seams(found: Array) -> dict[str, str]:
    rows = {}
    for low, high in JUMPS_PX:
        size = np.abs(found[:, 0])
        of_size = (size >= low) & (size < high)
        right, left = found[of_size & (found[:, 0] < 0)], found[of_size & (found[:, 0] > 0)]
        label = f"at steps of {low:.0f}-{high:.0f} px"
        rows[f"holes {label}, right of what is near, px"] = _spread(right[:, 2])
        rows[f"mixed depths {label}, right, mean px"] = f"{right[:, 1].mean():.2f}"
        rows[f"shadow {label}, left, wider than the step by, px"] = _spread(
            left[:, 2] - np.abs(left[:, 0])
        )
        rows[f"mixed depths {label}, left, mean px"] = f"{left[:, 1].mean():.2f}"
    return rows


def _spread(values: Array, digits: int = 1) -> str:
    low, middle, high = np.percentile(values, [10, 50, 90])
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def picture(real: Sequence[Float32s], simulated: Sequence[Float32s]) -> npt.NDArray[np.uint8]:
    """Real images above simulated ones, at full size, BGR: colours from 0 to 5 m, holes black."""
    import cv2  # noqa: PLC0415

    rows = []
    for name, images in (("real", real), ("simulated", simulated)):
        tiles = []
        for depth_m in (images[index % len(images)] for index in SHOWN[name]):
            # Few colours make a small file.
            levels = np.rint(np.clip(depth_m / SHOWN_TO_M, 0, 1) * 40) * (255 / 40)
            tile = cv2.applyColorMap(levels.astype(np.uint8), cv2.COLORMAP_TURBO)
            tile[depth_m == 0] = 0
            tiles.append(tile)
        row = np.hstack(tiles)
        cv2.putText(row, name, (90, 460), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (255, 255, 255), 2)
        rows.append(row)
    return np.vstack(rows).astype(np.uint8)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; exit code 2 for input that nothing can come of."""
    parser = argparse.ArgumentParser(prog="python -m slam.lab.simulation.depth_comparison")
    parser.add_argument("folder", type=Path, help="real depth images, 640 x 480, PNG, mm")
    parser.add_argument("--picture", type=Path, help="where to write the picture, a PNG")
    options = parser.parse_args(arguments)
    try:
        real = read_real(options.folder)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    model = DepthModel(mode="640x480")
    simulated = simulate(model)
    columns = measured(real, REAL_FOCAL_BASELINE), measured(simulated, model.focal_baseline)
    print("| | real | simulated |\n|---|---|---|")
    for label, value in columns[0].items():
        print(f"| {label} | {value} | {columns[1][label]} |")
    if options.picture:
        import cv2  # noqa: PLC0415

        cv2.imwrite(
            str(options.picture), picture(real, simulated), [cv2.IMWRITE_PNG_COMPRESSION, 9]
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
