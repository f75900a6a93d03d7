"""Whole runs with a depth camera: what they keep of it, and what they say when it fails them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from datasets.bag_messages import RosMessage
from datasets.bags import BagRecording
from datasets.messages import DepthImage
from datasets.options import ReadOptions
from datasets.simulation.bag_writer import write_bag
from datasets.simulation.place import load_place
from datasets.simulation.place_file import RobotName
from datasets.simulation.robot import ROBOTS
from datasets.simulation.simulated_drive import SimulatedDrive
from slam.config import Config, load_config
from slam.mapping.occupancy import OCCUPIED
from slam.mapping.scan_store import CAMERA, LIDAR
from slam.pipeline import Slam
from slam.runs.fusion_summary import fusion_lines
from slam.runs.interruption import Interruption
from slam.runs.run import RunDone, RunRequest, run_recording

PLACE = """\
floor: marble
walls:
  - name: room
    ring: [[-2, -2], [4, -2], [4, 2.5], [-2, 2.5], [-2, -2]]
    height_m: 2.5
boxes:
  - {name: crate, at_m: [2.5, 0.3], size_m: [0.4, 0.6, 0.3]}
drives:
  there: {way_points_m: [[-1, 0], [0.6, 0.1]], stand_s: 0.5}
"""
CRATE_FRONT_M = (3.3, 0.3)
"""The middle of the crate's front from where the robot starts."""

Pixels = npt.NDArray[np.uint16]

DEPTH = "/camera/depth/image_rect_raw/compressedDepth"
HEADER_BYTES = 12


class Silent:
    def stage(self, what: str) -> None: ...

    def progress(self, scans: int, recorded_s: float, closures: int) -> None: ...


class Bags(NamedTuple):
    """A recorded drive, and copies of it that something happened to."""

    folder: Path
    clean: Path


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Bags:
    folder = tmp_path_factory.mktemp("fused")
    (folder / "place.yaml").write_text(PLACE)
    return Bags(folder, drive(folder, "paper"))


def drive(folder: Path, robot: RobotName) -> Path:
    place = load_place(str(folder / "place.yaml"))
    simulated = SimulatedDrive(place, place.drives["there"], ROBOTS[robot], seed=4)
    path = folder / f"{robot}.mcap"
    write_bag(simulated, path)
    return path


Change = Callable[[RosMessage, float], RosMessage]
"""From a message and the seconds since the first to what is written; None: nothing is."""


def rewritten(bags: Bags, name: str, topic: str, change: Change) -> Path:
    """The clean bag with the messages of one topic changed."""
    store, path = get_typestore(Stores.ROS2_HUMBLE), bags.folder / name
    with (
        AnyReader([bags.clean]) as reader,
        Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        ids = {
            each.topic: writer.add_connection(each.topic, each.msgtype, typestore=store)
            for each in reader.connections
        }
        for connection, bag_ns, raw in reader.messages():
            if connection.topic == topic:
                message = store.deserialize_cdr(raw, connection.msgtype)
                message = change(message, (bag_ns - reader.start_time) * 1e-9)
                if message is not None:
                    changed = store.serialize_cdr(message, connection.msgtype)
                    writer.write(ids[topic], bag_ns, changed)
                continue
            writer.write(ids[connection.topic], bag_ns, raw)
    return path


def with_pixels(change: Callable[[Pixels], Pixels]) -> Change:
    """Change the pixels of compressedDepth images, (H, W) uint16."""

    def changed(message: RosMessage, time_s: float) -> RosMessage:
        data = message.data.tobytes()
        pixels = cv2.imdecode(np.frombuffer(data[HEADER_BYTES:], np.uint8), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        png = cv2.imencode(".png", change(pixels.astype(np.uint16)))[1].tobytes()
        message.data = np.frombuffer(data[:HEADER_BYTES] + png, np.uint8)
        return message

    return changed


def standing(child: str, **values: float) -> Change:
    """Move a frame of /tf_static. yaw half a turn: z = 1, w = 0."""

    def changed(message: RosMessage, time_s: float) -> RosMessage:
        for link in message.transforms:
            if link.child_frame_id == child:
                for key, value in values.items():
                    part = (
                        link.transform.translation
                        if key.endswith("_m")
                        else link.transform.rotation
                    )
                    setattr(part, key.removesuffix("_m"), value)
        return message

    return changed


def run(recording: Path, out: Path, *settings: str, config: Config | None = None) -> RunDone:
    config = config or load_config(None, settings)
    request = RunRequest((recording,), ReadOptions(), config, out=out)
    return run_recording(request, Silent(), Interruption())


def occupied_near(done: RunDone, layer: str | None, place_m: tuple[float, float]) -> int:
    """Occupied cells within 0.2 m of a place. layer : None is all of them together."""
    grid = done.grid if layer is None else done.grid.layers[layer]
    classes = grid.classes(Config().map)
    v, u = np.nonzero(classes == OCCUPIED)
    x = grid.corner_map_m[0] + (u + 0.5) * grid.resolution_m
    y = grid.corner_map_m[1] + (v + 0.5) * grid.resolution_m
    return int(np.count_nonzero(np.hypot(x - place_m[0], y - place_m[1]) < 0.2))


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.iterdir())
        if path.name not in ("timing.json", "config.yaml")
    }


def words(done: RunDone) -> str:
    return "\n".join(fusion_lines(done.run.metrics))


def test_the_map_keeps_the_low_box_that_the_lidar_passes_over(bags: Bags, tmp_path: Path) -> None:
    fused = run(bags.clean, tmp_path / "fused")
    lidar = run(bags.clean, tmp_path / "lidar", "sensors=lidar")
    assert occupied_near(fused, None, CRATE_FRONT_M) >= 4
    assert occupied_near(fused, CAMERA, CRATE_FRONT_M) >= 4
    assert occupied_near(fused, LIDAR, CRATE_FRONT_M) == 0
    assert occupied_near(lidar, None, CRATE_FRONT_M) == 0
    metrics = fused.run.metrics
    assert metrics["fusion"]["points"]["both"] > 20 * metrics["fusion"]["points"]["lidar"] / 1000
    assert metrics["left_out"] == {}
    assert "views taken in" in words(fused)
    assert "lidar and views" not in words(fused)
    assert words(lidar) == ""
    error = metrics["ground_truth"]["error"]
    assert error["ate_translation_m"]["rmse"] < 0.02
    names = {path.name for path in (tmp_path / "fused").iterdir()}
    assert {"map_camera.pgm", "map_lidar.pgm", "map_sources.png"} <= names


def test_the_same_bag_gives_the_same_bytes_whatever_the_threads(bags: Bags, tmp_path: Path) -> None:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        run(bags.clean, tmp_path / "one")
        cv2.setNumThreads(4)
        run(bags.clean, tmp_path / "four")
    finally:
        cv2.setNumThreads(before)
    assert files(tmp_path / "one") == files(tmp_path / "four")


@pytest.mark.parametrize(
    "settings", [["fusion=paper"], ["fusion=union"], ["compensation.layers=false"]]
)
def test_a_single_grid_holds_the_box_too(bags: Bags, tmp_path: Path, settings: list[str]) -> None:
    done = run(bags.clean, tmp_path / "out", *settings)
    assert len(done.grid.layers) == 1
    assert occupied_near(done, None, CRATE_FRONT_M) >= 4
    assert "a single grid" in words(done)


def test_the_camera_alone_maps_what_it_sees(bags: Bags, tmp_path: Path) -> None:
    done = run(bags.clean, tmp_path / "out", "sensors=camera")
    assert occupied_near(done, None, CRATE_FRONT_M) >= 4
    assert done.run.metrics["scans_by_sensor"] == {DEPTH: done.run.metrics["scans"]}
    assert "mapped by depth cameras alone" in words(done)


def test_a_second_lidar_stands_in_for_the_camera(bags: Bags, tmp_path: Path) -> None:
    recording = drive(bags.folder, "two-lidars")
    done = run(recording, tmp_path / "out")
    assert occupied_near(done, None, CRATE_FRONT_M) >= 4
    metrics = done.run.metrics
    assert list(metrics["scans_by_sensor"]) == ["/scan"]
    assert list(metrics["fusion"]["views"]) == ["/scan_low"]
    high = run(recording, tmp_path / "high", "sensors=lidar")
    assert list(high.run.metrics["scans_by_sensor"]) == ["/scan"]
    assert occupied_near(high, None, CRATE_FRONT_M) == 0


@pytest.mark.parametrize("begins", [True, False])
def test_a_stream_that_stops_or_begins_half_way_is_used_as_far_as_it_goes(
    bags: Bags, tmp_path: Path, begins: bool
) -> None:
    def half(message: RosMessage, time_s: float) -> RosMessage:
        return message if (time_s > 2.0) == begins else None

    done = run(rewritten(bags, f"half-{begins}", DEPTH, half), tmp_path / "out")
    metrics = done.run.metrics
    assert metrics["fusion"]["views"][DEPTH] > 0
    lost = metrics["fusion"]["scans_without_view"][DEPTH]
    assert 5 < lost < metrics["scans"]
    assert f"scans without a view of {DEPTH} near in time, lidar alone there: {lost}" in words(done)


def no_image(message: RosMessage, time_s: float) -> RosMessage:
    message.format = "bgr8; jpeg compressed bgr8"
    return message


def days_later(message: RosMessage, time_s: float) -> RosMessage:
    message.header.stamp.sec += 86_400
    return message


def seconds_later(message: RosMessage, time_s: float) -> RosMessage:
    message.header.stamp.sec += 3
    return message


LOST: dict[str, tuple[str, Change, str]] = {
    "size": (
        DEPTH,
        with_pixels(lambda mm: mm[::2, ::2]),
        "320 x 240 pixels, its intrinsics are for",
    ),
    "encoding": (DEPTH, no_image, "is none of a depth image"),
    "day": (DEPTH, days_later, "more than 30 s away"),
    "seconds": (DEPTH, seconds_later, "stamped 3.0 s later"),
    "info": ("/camera/depth/camera_info", lambda message, time_s: None, "no CameraInfo"),
    "underground": ("/tf_static", standing("camera_link", z_m=-0.5), "must stand above the floor"),
}


@pytest.mark.parametrize("what", LOST)
def test_without_one_usable_image_the_lidar_goes_on_alone(
    bags: Bags, tmp_path: Path, what: str
) -> None:
    topic, change, said = LOST[what]
    done = run(rewritten(bags, what, topic, change), tmp_path / "out")
    metrics = done.run.metrics
    lost = {**metrics["left_out"], **metrics["reader_notes"]}
    counts = [count for reason, count in lost.items() if said in reason]
    assert len(counts) == 1
    with AnyReader([bags.clean]) as reader:
        assert counts == [reader.topics[DEPTH].msgcount]
    assert metrics["fusion"]["views"] == {}
    alone = run(bags.clean, tmp_path / "alone", "sensors=lidar")
    assert (tmp_path / "out/map.pgm").read_bytes() == (tmp_path / "alone/map.pgm").read_bytes()
    assert alone.run.metrics["scans"] == metrics["scans"]
    if what not in ("encoding", "info"):  # then the camera isn't known at all
        assert "mapped by the lidar alone" in words(done)


def test_blind_images_are_counted_and_cost_nothing(bags: Bags, tmp_path: Path) -> None:
    blind = rewritten(bags, "blind", DEPTH, with_pixels(np.zeros_like))
    done = run(blind, tmp_path / "out")
    notes = done.run.metrics["reader_notes"]
    assert any("without one measurement" in note for note in notes)
    assert done.run.metrics["fusion"]["points"]["camera"] == 0
    assert occupied_near(done, None, CRATE_FRONT_M) == 0


def test_the_time_of_views_counts_as_fusion(bags: Bags) -> None:
    recording = BagRecording([bags.clean], ReadOptions())
    slam = Slam(Config(), recording.calibration)
    view = next(message for message in recording if isinstance(message, DepthImage))
    slam.add(view)
    assert slam.fusing.view_counts[DEPTH] == 1
    assert slam.seconds["fusion"] > 0.0


def test_a_camera_that_looks_elsewhere_than_said_is_told(bags: Bags, tmp_path: Path) -> None:
    turned = standing("camera_link", x=0.0, y=0.0, z=1.0, w=0.0)
    done = run(rewritten(bags, "turned", "/tf_static", turned), tmp_path / "out")
    assert "lidar and views agree on only" in words(done)
    assert done.run.metrics["ground_truth"]["error"]["ate_translation_m"]["rmse"] < 0.02


def test_a_camera_that_looks_where_the_lidar_does_not_is_told(bags: Bags, tmp_path: Path) -> None:
    def behind(message: RosMessage, time_s: float) -> RosMessage:
        """A clockwise lidar begins behind: what is ahead lies in the middle."""
        third = len(message.ranges) // 3
        message.ranges = message.ranges.copy()
        message.ranges[third:-third] = np.nan
        return message

    done = run(rewritten(bags, "behind", "/scan", behind), tmp_path / "out")
    assert "measured in no common direction" in words(done)
    assert occupied_near(done, CAMERA, CRATE_FRONT_M) >= 4
