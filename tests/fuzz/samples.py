"""Good inputs of every kind, small, which the fuzzer then spoils."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from slam.commands.config_text import config_lines
from tests.datasets.bag_factory import (
    T0_NS,
    Entry,
    Format,
    S,
    camera_info_entry,
    compressed_entry,
    image_entry,
    odometry_entry,
    png,
    pose_entry,
    scan_entry,
    storage_file,
    string_entry,
    tf_entry,
    write_bag,
)
from tests.slam.runs.test_run_folder import make_run, write

SCANS = 6


@dataclass(frozen=True)
class Sample:
    """A good input: the files of it by their names, the spoilt one first. is_text : of it."""

    kind: str
    name: str
    files: dict[str, bytes]
    is_text: bool

    @property
    def spoilt(self) -> str:
        return next(iter(self.files))


def samples() -> tuple[Sample, ...]:
    """All of them, the same in every process."""
    return tuple(_all())


@lru_cache(maxsize=1)
def _drive() -> tuple[Entry, ...]:
    camera = "camera_depth_optical_frame"
    upright = (-0.5, 0.5, -0.5, 0.5)
    entries: list[Entry] = [
        tf_entry(
            T0_NS,
            ("base_link", "laser", (0.2, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0)),
            ("base_link", camera, (0.1, 0.0, 0.25), upright),
            topic="/tf_static",
        ),
        camera_info_entry(T0_NS),
    ]
    depth = np.linspace(500, 3000, 48).astype(np.uint16).reshape(6, 8)
    for k in range(SCANS):
        at_ns = T0_NS + k * S // 5
        ranges = list(2.0 + np.sin(np.arange(24) * 0.3 + k))
        entries.append(scan_entry(at_ns, ranges=ranges, angle_min=-3.0, angle_increment=0.25))
        entries.append(odometry_entry(at_ns + 1, 0.1 * k))
        entries.append(
            tf_entry(at_ns + 2, ("odom", "base_link", (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        )
        entries.append(pose_entry(at_ns + 3, 0.1 * k, 0.0, 0.0))
        entries.append(image_entry(at_ns + 4, depth))
        packed = png(depth)
        entries.append(compressed_entry(at_ns + 5, struct.pack("<iff", 0, 0.0, 0.0) + packed))
        entries.append(string_entry(at_ns + 6, f"{k}"))
    return tuple(entries)


def _all() -> Iterator[Sample]:
    yield from _bags()
    yield from _logs()
    yield from _texts()
    yield from _run_folders()


def _bags() -> Iterator[Sample]:
    kinds: list[tuple[Format, str]] = [
        ("ros1", ""), ("ros1", "bz2"), ("ros1", "lz4"),
        ("mcap", ""), ("mcap", "storage"), ("sqlite3", ""), ("sqlite3", "message"),
    ]  # fmt: skip
    with TemporaryDirectory() as folder:
        for kind, compression in kinds:
            bag = write_bag(
                Path(folder), kind, _drive(), name=f"{kind}{compression}",
                compression=compression, chunk_bytes=4000,
            )  # fmt: skip
            file = storage_file(bag)
            ending = "" if kind == "ros1" else file.suffix
            name = f"drive{ending or '.bag'}"
            yield Sample("bag", f"{kind} {compression}".strip(), {name: file.read_bytes()}, False)
            if kind == "mcap" and compression == "storage":
                metadata = (bag / "metadata.yaml").read_bytes()
                files = {"drive/metadata.yaml": metadata, f"drive/{file.name}": file.read_bytes()}
                yield Sample("folder", "metadata", files, True)
    yield Sample("bag", "mcap without chunks", {"loose.mcap": _loose_mcap()}, False)


def _loose_mcap() -> bytes:
    """The messages without chunks and checksums, so that spoilt bytes reach the messages."""
    from datasets.bag_index import IndexedFile
    from datasets.bag_records import MCAP_MAGIC

    def text(*words: str) -> bytes:
        return b"".join(struct.pack("<I", len(w.encode())) + w.encode() for w in words)

    with TemporaryDirectory() as folder:
        file = storage_file(write_bag(Path(folder), "mcap", _drive()))
        source = IndexedFile(file, MCAP_MAGIC)
        records: list[tuple[int, bytes]] = [(1, text("ros2", ""))]
        for number, channel in source.channels.items():
            schema = struct.pack("<H", number + 1) + text(channel.msgtype, "ros2msg", "")
            records.append((3, schema))
            head = struct.pack("<HH", number, number + 1)
            records.append((4, head + text(channel.topic, channel.encoding) + bytes(4)))
        for number, bag_ns, data in source.entries(source.channels.keys()):
            records.append((5, struct.pack("<HIQQ", number, 0, bag_ns, bag_ns) + data))
    records += [(15, bytes(4)), (2, bytes(20))]
    body = b"".join(struct.pack("<BQ", op, len(data)) + data for op, data in records)
    return MCAP_MAGIC + body + MCAP_MAGIC


def _logs() -> Iterator[Sample]:
    ranges = " ".join(f"{2.0 + 0.1 * k:.2f}" for k in range(18))
    zeros = " ".join(["0"] * 5)
    old, new = ["PARAM robot_frontlaser_offset 0.2 1.0 h 1.0"], []
    for k in range(1, SCANS + 1):
        pose = f"{0.1 * k:.1f} 0 0"
        old.append(f"ODOM {pose} 0 0 0 {k}.0 h {k}.0")
        old.append(f"FLASER 18 {ranges} {pose} {pose} {k}.1 h {k}.1")
        old.append(f"RLASER 18 {ranges} {pose} {pose} {k}.1 h {k}.1")
        head = f"ROBOTLASER1 0 -1.57 3.14 0.1745 20 0.01 0 18 {ranges} 0"
        new.append(f"{head} {pose} {pose} {zeros} {k}.1 h {k}.1")
    for name, lines in (("old", old), ("new", new)):
        text = ("\n".join(lines) + "\n").encode()
        yield Sample("log", f"carmen {name}", {"drive.log": text}, True)
    packed = gzip.compress(("\n".join(old) + "\n").encode(), mtime=0)
    yield Sample("log", "carmen gz", {"drive.log.gz": packed}, False)


CALIBRATION = """\
lidars:
  /scan:
    mounting: {x_m: 0.31, y_m: 0.0, z_m: 0.1, roll_deg: 180, pitch_deg: 0, yaw_deg: 0}
    mask_deg: [[-180, -150], [150, 180]]
    clock_offset_s: -0.08
cameras:
  /camera/depth/image_rect_raw:
    mounting: {x_m: 0.15, z_m: 0.25, pitch_deg: 5}
    intrinsics: {width_px: 8, height_px: 6, fx_px: 8, fy_px: 8, cx_px: 4, cy_px: 3}
    clock_offset_s: 0.03
odometry: /odom
ground_truth: /ground_truth
"""
STRUCTURES = "structures:\n  hall: {from_m: [0.0, 1.0], to_m: [12.0, 1.0], length_m: 12.34}\n"
DRIVE = "way_points_m: [[0.0, 0.0], [0.2, 0.1]]\nstart_yaw_deg: 0\nclosed: true\nstand_s: 1\n"


def _texts() -> Iterator[Sample]:
    from importlib.resources import files

    place = files("datasets.simulation").joinpath("places", "beam-room.yaml").read_bytes()
    office = files("datasets.simulation").joinpath("places", "office.yaml").read_bytes()
    config = "\n".join(config_lines()).encode()
    poses = "".join(f"{100 + k}.25 {0.1 * k} 0 0 0 0 0 1\n" for k in range(9))
    relations = "".join(f"{100 + k} {101 + k} 0.1 0 0 0 0 0.01\n" for k in range(9))
    yield Sample("calibration", "calibration", {"calibration.yaml": CALIBRATION.encode()}, True)
    yield Sample("config", "config", {"config.yaml": config}, True)
    yield Sample("place", "beam-room", {"place.yaml": place}, True)
    yield Sample("place", "office", {"place.yaml": office}, True)
    yield Sample("drive", "drive", {"drive.yaml": DRIVE.encode()}, True)
    yield Sample("structures", "structures", {"structures.yaml": STRUCTURES.encode()}, True)
    yield Sample("tum", "tum", {"poses.tum": poses.encode()}, True)
    yield Sample("relations", "relations", {"pairs.relations": relations.encode()}, True)
    for name, vertex, edge in (("g2o", "VERTEX_SE2", "EDGE_SE2"), ("toro", "VERTEX2", "EDGE2")):
        six = "400 0 0 400 0 900" if name == "g2o" else "400 0 400 900 0 0"
        lines = [f"{vertex} {k} {k % 4} {k // 4} 0.1" for k in range(8)]
        lines += [f"{edge} {k} {k + 1} 1 0 0 {six}" for k in range(7)]
        lines += [f"{edge} {a} {b} 0.1 0.9 0 {six}" for a, b in ((0, 4), (1, 5), (7, 3))]
        text = ("\n".join(lines) + "\nFIX 0\n").encode()
        yield Sample("graph", name, {f"graph.{name}": text}, True)


def _run_folders() -> Iterator[Sample]:
    with TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        write(run, make_run())
        files = {f"run/{path.name}": path.read_bytes() for path in sorted(run.iterdir())}
    texts = ("metrics.json", "timing.json", "config.yaml", "constraints.csv",
             "trajectory.tum", "odometry.tum")  # fmt: skip
    for name in (*texts, "scans.npz"):
        first = {f"run/{name}": files[f"run/{name}"]}
        yield Sample("run", name, first | files, name in texts)
