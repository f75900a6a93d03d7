"""The maps of several systems side by side, each coloured by the layer that saw a cell."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datasets.whole_file import write_whole
from slam.lab.drives.mapping import Mapped
from slam.mapping.pictures import write_sources

WIDTH_PX = 700
CAPTION_PX = 36


def write_side_by_side(path: Path, maps: Sequence[Mapped]) -> None:
    """Write a PNG, two maps in a row, each with its name. Raises OSError if it can't be written."""
    import cv2  # noqa: PLC0415

    tiles = []
    with tempfile.TemporaryDirectory() as folder:
        for number, mapped in enumerate(maps):
            single = Path(folder) / f"{number}.png"
            config = mapped.slam.config.map
            write_sources(single, mapped.map, config, mapped.poses.trajectory)
            picture = cv2.imread(str(single))
            assert picture is not None  # just written
            height = round(picture.shape[0] * WIDTH_PX / picture.shape[1])
            small = cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            caption = np.full((CAPTION_PX, WIDTH_PX, 3), 255, np.uint8)
            words, font = mapped.system.name, cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(caption, words, (8, 26), font, 0.8, (0, 0, 0), 1, cv2.LINE_AA)
            tiles.append(np.vstack([caption, small]))
    lowest = max(len(tile) for tile in tiles)
    padded = [
        np.pad(tile, ((0, lowest - len(tile)), (0, 0), (0, 0)), constant_values=255)
        for tile in tiles
    ]
    if len(padded) % 2:
        padded.append(np.full_like(padded[0], 255))
    pairs = [np.hstack(padded[k : k + 2]) for k in range(0, len(padded), 2)]
    encoded = cv2.imencode(".png", np.vstack(pairs), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, encoded.tobytes())
