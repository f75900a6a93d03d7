"""Options of the command line become those of the reader."""

from __future__ import annotations

import pytest

from datasets.errors import InputError
from datasets.options import ReadOptions
from slam.commands.options import read_options


def test_everything_is_read_unless_an_option_says_otherwise() -> None:
    found = read_options(0.0, None, None, None, None, None, salvage=False)
    assert found == ReadOptions()


def test_cameras_are_chosen_or_left_out() -> None:
    plain = (0.0, None, None, ["/scan"], None, None)
    chosen = read_options(*plain, salvage=False, cameras=["/a", "/b"])
    assert chosen == ReadOptions(lidars=("/scan",), cameras=("/a", "/b"))
    assert not read_options(*plain, salvage=False, no_camera=True).use_cameras
    every = read_options(0.0, None, None, None, None, None, salvage=False, no_lidar=True)
    assert not every.use_lidars


def test_what_is_left_out_can_not_be_asked_for() -> None:
    plain = (0.0, None, None, ["/scan"], None, None)
    with pytest.raises(InputError, match="--camera asks"):
        read_options(*plain, salvage=False, cameras=["/a"], no_camera=True)
    with pytest.raises(InputError, match="--lidar asks"):
        read_options(*plain, salvage=False, no_lidar=True)
