"""Options of the command line become those of the reader."""

from __future__ import annotations

from datasets.options import ReadOptions
from slam.cli_options import read_options


def test_everything_is_read_unless_an_option_says_otherwise() -> None:
    found = read_options(0.0, None, None, None, None, None, salvage=False)
    assert found == ReadOptions()


def test_cameras_are_chosen_or_left_out() -> None:
    plain = (0.0, None, None, ["/scan"], None, None)
    chosen = read_options(*plain, salvage=False, cameras=["/a", "/b"])
    assert chosen == ReadOptions(lidars=("/scan",), cameras=("/a", "/b"))
    assert not read_options(*plain, salvage=False, no_camera=True).use_cameras
    assert not read_options(*plain, salvage=False, no_lidar=True).use_lidars
