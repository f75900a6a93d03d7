"""The map as Nav2's map_server reads it: an image and a YAML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, MapConfig, Raster

PIXELS = {UNKNOWN: 205, FREE: 254, OCCUPIED: 0}


def write_map(folder: Path, grid: Raster, config: MapConfig, *, name: str = "map") -> None:
    """Write ``name.pgm`` and ``name.yaml`` into a folder that exists.

    The thresholds of the config decide here which cells are occupied and free. Those in the YAML
    file tell a reader how to decode the three grey values, and never change: 205 is read as
    (255 - 205) / 255 = 0.19608 and stays unknown above free_thresh 0.196 only.

    Raises OSError where a file cannot be written.
    Source: nav2_map_server, map_io.cpp (trinary mode).
    """
    classes = grid.classes(config)
    palette = np.array([PIXELS[k] for k in sorted(PIXELS)], np.uint8)
    image = palette[classes][::-1]
    height, width = image.shape
    header = f"P5\n{width} {height}\n255\n".encode("ascii")
    with (folder / f"{name}.pgm").open("wb") as file:
        file.write(header)
        file.write(np.ascontiguousarray(image).data)
    x_m, y_m = grid.corner_map_m
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.pgm\n"
        "mode: trinary\n"
        f"resolution: {grid.resolution_m:.9g}\n"
        f"origin: [{x_m:.9g}, {y_m:.9g}, 0.0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        "free_thresh: 0.196\n",
        encoding="ascii",
    )
