"""The store of all scans: what it refuses, its layers, and the way to a file and back."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.mapping.scan_store import BEAM, CAMERA, CLEAR, LIDAR, SURFACE, VAGUE, ScanStore
from slam.runs.scan_files import read_scans, write_scans


def store(count: int = 4) -> ScanStore:
    """Scans of 0, 1, 2, ... points, by a lidar and a camera in turn."""
    rng = np.random.default_rng(2)
    return ScanStore.from_scans(
        [k // 2 for k in range(count)],
        [("/scan", "/depth")[k % 2] for k in range(count)],
        [rng.uniform(-5, 5, (k, 2)) for k in range(count)],
        {"/scan": (0.1, 0.0), "/depth": (0.2, 0.05)},
        roles=[np.full(k, (BEAM, CLEAR)[k % 2], np.uint8) for k in range(count)],
        layers={"/depth": CAMERA},
        clear_from_m={"/depth": 0.4},
    )


def test_what_is_not_said_of_a_sensor_is_that_of_a_lidar() -> None:
    scans = store()
    assert scans.sensors == ("/depth", "/scan")
    assert scans.layers == (CAMERA, LIDAR)
    assert scans.clear_from_m.tolist() == [0.4, 0.0]
    plain = ScanStore.from_scans([1], ["a"], [np.zeros((3, 2))], {"a": (0, 0)})
    assert plain.roles.tolist() == [BEAM] * 3
    assert plain.layers == (LIDAR,)


def test_a_layer_holds_its_sensors_scans_in_order() -> None:
    scans = store(6)
    assert scans.layer_names == (CAMERA, LIDAR)
    camera = scans.of_layer(CAMERA)
    assert camera.stamps_ns.tolist() == [0, 1, 2]
    assert np.diff(camera.offsets).tolist() == [1, 3, 5]
    for row, index in enumerate((1, 3, 5)):
        ours = camera.points_base[camera.offsets[row] : camera.offsets[row + 1]]
        theirs = scans.points_base[scans.offsets[index] : scans.offsets[index + 1]]
        np.testing.assert_array_equal(ours, theirs)
    assert (camera.roles == CLEAR).all()
    assert camera.of_layer(CAMERA) is camera
    assert not len(camera.of_layer(LIDAR))
    assert camera.layer_names == (CAMERA,)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"offsets": np.array([0, 0, 1, 3, 5])}, "offsets"),
        ({"offsets": np.array([0, 2, 1, 3, 6])}, "offsets"),
        ({"sensor_index": np.array([0, 1, 2, 1])}, "not there"),
        ({"stamps_ns": np.array([0, 1, 0, 1])}, "decrease"),
        ({"points_base": np.zeros((6, 2))}, "points_base"),
        ({"points_base": np.full((6, 2), np.inf, np.float32)}, "finite"),
        ({"roles": np.full(6, 4, np.uint8)}, "roles"),
        ({"roles": np.zeros(5, np.uint8)}, "roles"),
        ({"layers": (CAMERA,)}, "layers"),
        ({"layers": (CAMERA, "")}, "layers"),
        ({"clear_from_m": np.array([0.1, np.nan])}, "finite"),
        ({"origins_base": np.zeros((1, 2))}, "origins_base"),
    ],
)
def test_what_does_not_fit_together_is_refused(change: dict[str, object], words: str) -> None:
    fields = {name: getattr(store(), name) for name in ScanStore.__slots__}
    with pytest.raises(ValueError, match=words):
        ScanStore(**{**fields, **change})


NAMES = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), min_size=1)
FLOATS = st.floats(-1e4, 1e4, width=32)


@st.composite
def stores(draw: st.DrawFn) -> ScanStore:
    sensors = draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))
    counts = draw(st.lists(st.integers(0, 4), max_size=6))
    owners = [draw(st.sampled_from(sensors)) for _ in counts]
    points = [
        np.array(draw(st.lists(FLOATS, min_size=2 * k, max_size=2 * k)), np.float32).reshape(-1, 2)
        for k in counts
    ]
    roles = [
        np.array([draw(st.sampled_from([BEAM, SURFACE, CLEAR, VAGUE])) for _ in range(k)], np.uint8)
        for k in counts
    ]
    stamps = sorted(draw(st.integers(-(2**62), 2**62)) for _ in counts)
    return ScanStore.from_scans(
        stamps,
        owners,
        points,
        {name: (draw(FLOATS), draw(FLOATS)) for name in sensors},
        roles=roles,
        layers={name: draw(NAMES) for name in sensors},
        clear_from_m={name: draw(st.floats(0.0, 5.0)) for name in sensors},
    )


@settings(max_examples=60, deadline=None)
@given(stores())
def test_any_store_reads_back_as_it_was(scans: ScanStore) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scans.npz"
        write_scans(path, scans)
        back = read_scans(path)
    for name in ScanStore.__slots__:
        mine, theirs = getattr(scans, name), getattr(back, name)
        if isinstance(mine, np.ndarray):
            assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(theirs, mine)
    together = [back.of_layer(name) for name in back.layer_names]
    assert sum(map(len, together)) == len(scans)
    assert sum(len(part.points_base) for part in together) == len(scans.points_base)


def test_a_store_of_an_earlier_version_is_one_of_lidars(tmp_path: Path) -> None:
    """As folders were written before there were layers."""
    scans = store()
    np.savez(
        tmp_path / "scans.npz",
        stamps_ns=scans.stamps_ns,
        lidar_index=scans.sensor_index,
        offsets=scans.offsets,
        points_base=scans.points_base,
        lidars=np.array(scans.sensors),
        origins_base=scans.origins_base,
    )
    back = read_scans(tmp_path / "scans.npz")
    assert back.sensors == scans.sensors
    assert back.layers == (LIDAR, LIDAR)
    assert (back.roles == BEAM).all()
    assert back.clear_from_m.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(back.points_base, scans.points_base)


def test_a_damaged_store_is_refused(tmp_path: Path) -> None:
    scans = store()
    fields = {name: getattr(scans, name) for name in ScanStore.__slots__}
    for damage in ({"roles": np.full(6, 9, np.uint8)}, {"layers": np.array(["camera"])}):
        np.savez(tmp_path / "scans.npz", **{**fields, **damage})
        with pytest.raises(ValueError, match=r"roles|layers"):
            read_scans(tmp_path / "scans.npz")
    del fields["roles"]
    np.savez(tmp_path / "scans.npz", **fields)
    with pytest.raises(KeyError, match="roles"):
        read_scans(tmp_path / "scans.npz")
