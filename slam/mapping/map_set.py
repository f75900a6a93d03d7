"""All files that show a map: the combined one, one a layer, and pictures for people."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from datasets.trajectory import Trajectory
from slam.mapping.layers import LayeredMap
from slam.mapping.map_files import write_map
from slam.mapping.occupancy import MapConfig
from slam.mapping.pictures import write_picture, write_sources

MAP_PICTURE = "map.png"
SOURCES_PICTURE = "map_sources.png"


def write_map_set(
    folder: Path,
    layers: LayeredMap,
    config: MapConfig,
    T_map_base: Trajectory,
    doubtful: Sequence[tuple[float, float]] = (),
) -> None:
    """Write map.pgm, .yaml and .png; of several layers also map_<layer>.pgm and .yaml of each and
    map_sources.png. doubtful : (x, y) m, places that map.png marks.

    Raises OSError where a file cannot be written.
    """
    write_map(folder, layers, config)
    write_picture(folder / MAP_PICTURE, layers, config, T_map_base, doubtful)
    if len(layers.layers) == 1:
        return
    for name, grid in zip(_file_names(list(layers.layers)), layers.layers.values(), strict=True):
        write_map(folder, grid, config, name=name)
    write_sources(folder / SOURCES_PICTURE, layers, config, T_map_base)


def _file_names(layers: list[str]) -> list[str]:
    """``map_<layer>`` in letters that any file system takes; numbered where two become equal."""
    names: list[str] = []
    for layer in layers:
        base = "map_" + (re.sub(r"[^A-Za-z0-9.-]+", "-", layer).strip(".-").lower() or "layer")
        taken = sum(name == base or name.startswith(f"{base}_") for name in names)
        names.append(f"{base}_{taken + 1}" if taken else base)
    return names
