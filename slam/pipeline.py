"""The life of a scan: read -> fuse -> predict -> match -> insert -> graph -> search loops."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from backend.finish import Finished, finish, nodes_at
from backend.global_slam import GlobalSlam
from backend.graph_arrays import joined
from backend.pose_graph_files import PoseGraphFile
from backend.refine import steps_between
from backend.spread import spread
from datasets.messages import Array, DepthImage, LaserScan, Message, Odometry
from datasets.recording import Calibration
from datasets.se2 import inverse, transform, xyyaw_rows
from datasets.trajectory import Trajectory
from frontend.local_slam import LocalResult, LocalSlam
from frontend.match import Match
from frontend.motion import MotionModel
from frontend.nodes import NodeKeeper
from slam.config import Config
from slam.front_ends import tracker_of
from slam.fusing import Fusing
from slam.leap import LeapGuard
from slam.mapping.camera_records import ViewRecord
from slam.mapping.layers import LayeredMap, draw_map
from slam.mapping.scan_records import Poses, ScanRecord, scan_store
from slam.mapping.scan_store import ScanStore
from slam.mapping.view_clock import ViewClock, view_clock

Rows = npt.NDArray[np.int64]

FIRST_ODOMETRY_S = 1.0
LATE_ODOMETRY_S = 0.3


class Slam:
    """SLAM, one message at a time: ``add`` what sensors say, ask for pose and map at any time.

    calibration : where the sensors stand; may be filled until a sensor's first message comes.
    """

    def __init__(self, config: Config, calibration: Calibration) -> None:
        self.config = config
        self._calibration = calibration
        self._waiting: deque[LaserScan | DepthImage] = deque()
        self._views: deque[LaserScan | DepthImage] = deque()
        self._newest_ns = 0
        keeper = NodeKeeper(config.nodes)
        self.local = LocalSlam(MotionModel(config.motion), tracker_of(config), keeper)
        self.nodes, self.submaps = keeper.nodes, keeper.submaps
        self.global_slam = GlobalSlam(config.loop_search, self.nodes, self.submaps)
        self.records: list[ScanRecord] = []
        self.odometry: list[Odometry] = []
        self.left_out: Counter[str] = Counter()
        self.fusing = Fusing(config, calibration, self.local.motion, self.left_out)
        kinds = (LaserScan, DepthImage, Odometry)
        self._leaps = {kind: LeapGuard(self.left_out) for kind in kinds}
        self._ended = False
        self.view_clocks: dict[str, ViewClock] = {}
        """Of the sensors whose stamps were found to be off: their views are moved in the map."""
        self.finished: Finished | None = None
        stages = ("fusion", "local", "loops", "final passes")
        self.seconds: dict[str, float] = dict.fromkeys(stages, 0.0)

    def add(self, message: Message) -> list[LocalResult]:
        """Take a message. Returns what became of the scans that it completed, often just one.

        A scan waits for odometry that reaches to its end, but not for long. One that is stamped
        long after all others waits for a second one that says the same, or is left out.

        Raises RuntimeError after ``finish``, ValueError for a scan that can't be used.
        """
        if self._ended:
            raise RuntimeError("no message can be taken after finish()")
        for known in self._leaps[type(message)].passed(message):
            if isinstance(known, Odometry):
                self._add_odometry(known)
            elif self.fusing.is_scan(known):
                self._waiting.append(known)
            elif self.fusing.is_view(known):
                self._views.append(known)
            self._newest_ns = max(self._newest_ns, known.stamp_ns)
        return self._work(final=False)

    def flush(self) -> list[LocalResult]:
        """Take in scans that still wait for odometry."""
        return self._work(final=True)

    def _add_odometry(self, message: Odometry) -> None:
        if self.odometry and message.stamp_ns <= self.odometry[-1].stamp_ns:
            self.left_out["odometry left out: not newer than the one before"] += 1
            return
        self.odometry.append(message)
        if self.config.odometry:
            self.local.add_odometry(message)

    def _work(self, *, final: bool) -> list[LocalResult]:
        # a depth image is of one moment; the turn of a lidar is de-skewed, and waits as scans do
        while self._views and (
            final or isinstance(self._views[0], DepthImage) or self._ready(self._views[0])
        ):
            started = time.perf_counter()
            self.fusing.add_view(self._views.popleft())
            self.seconds["fusion"] += time.perf_counter() - started
        done = []
        while self._waiting and (final or self._ready(self._waiting[0])):
            result = self._add_scan(self._waiting.popleft())
            if result is not None:
                done.append(result)
        return done

    def _ready(self, scan: LaserScan | DepthImage) -> bool:
        end_ns = scan.stamp_ns
        if isinstance(scan, LaserScan):
            end_ns += int(1e9 * float(scan.beam_offsets_s.max(initial=0.0)))
        if self.fusing.awaits_views and self._newest_ns < end_ns:
            return False
        if not self.config.odometry:
            return True
        reached_ns = self.local.motion.odometry_ns
        if reached_ns is not None and reached_ns >= end_ns:
            return True
        patience_s = FIRST_ODOMETRY_S if reached_ns is None else LATE_ODOMETRY_S
        return self._newest_ns - end_ns > patience_s * 1e9

    def _add_scan(self, scan: LaserScan | DepthImage) -> LocalResult | None:
        """The life of one scan."""
        if self._stale(scan):
            self.left_out["scan left out: stamp not newer than the one before"] += 1
            return None
        started = time.perf_counter()
        fused = self.fusing.fused(scan)
        if fused is None:
            return None
        fused_done = time.perf_counter()
        result = self.local.add_scan(fused)
        local_done = time.perf_counter()
        self._record(result)
        if self.config.loops:
            if result.submap is not None:
                self.global_slam.add_submap(result.submap)
            self.global_slam.step()
        self.seconds["fusion"] += fused_done - started
        self.seconds["local"] += local_done - fused_done
        self.seconds["loops"] += time.perf_counter() - local_done
        return result

    def _stale(self, scan: LaserScan | DepthImage) -> bool:
        """Not newer than the last scan; two sensors may share a stamp."""
        if not self.records:
            return False
        last = self.records[-1]
        name = scan.lidar if isinstance(scan, LaserScan) else scan.camera
        return scan.stamp_ns < last.stamp_ns or (
            scan.stamp_ns == last.stamp_ns and name == last.sensor
        )

    def _record(self, result: LocalResult) -> None:
        scan = result.tracked.scan
        self.records.append(
            ScanRecord(
                scan.stamp_ns,
                scan.moment_ns,
                scan.sensor,
                scan.points_base[: scan.main_count].astype(np.float32),
                result.tracked.T_odom_base,
                self.local.keeper.way_m,
                isinstance(result.tracked.outcome, Match),
            )
        )

    @property
    def T_map_base(self) -> Array:
        """The newest pose of the base in the map, (3, 3)."""
        if not self.records:
            return np.eye(3)
        T: Array = self.global_slam.T_map_odom() @ self.records[-1].T_odom_base
        return T

    def T_map_nodes(self) -> Array:
        """(N, 3, 3) the present poses of all nodes."""
        if self.finished is not None:
            return self.finished.T_map_nodes
        anchors = self.global_slam.T_map_anchors()
        if not len(anchors):
            return np.array([node.T_odom_base for node in self.nodes]).reshape(-1, 3, 3)
        return nodes_at(self.nodes, self.submaps, anchors)

    def T_map_scans(self) -> Array:
        """(M, 3, 3) the present poses of the base at the moments of ``records``."""
        if not self.records:
            return np.zeros((0, 3, 3))
        stamps = np.array([record.stamp_ns for record in self.records])
        T_odom = np.array([record.T_odom_base for record in self.records])
        at_node = {(node.scan.stamp_ns, node.scan.sensor): node.index for node in self.nodes}
        rows, nodes = [], []
        for row, record in enumerate(self.records):
            index = at_node.get((record.stamp_ns, record.sensor))
            if index is not None:
                rows.append(row)
                nodes.append(index)
        way = np.array([record.way_m for record in self.records])
        seconds = (stamps - stamps[0]) * 1e-9
        return spread(np.array(rows), self.T_map_nodes()[nodes], T_odom, way + 1e-3 * seconds)

    def trajectory(self) -> Trajectory:
        """The present poses of the base at the stamps of all scans; scans of one stamp share one.

        Between the moments that were matched the base is taken to move evenly.
        """
        return self.poses().trajectory

    def _at_stamps(self, T_map_scans: Array, rows: Rows) -> Trajectory:
        """From the poses at the moments of some ``records`` to those at their stamps."""
        records = [self.records[row] for row in rows.tolist()]
        order = np.argsort([record.moment_ns for record in records], kind="stable")
        moments = np.array([records[i].moment_ns for i in order], dtype=np.int64)
        distinct = np.ones(len(moments), dtype=bool)
        distinct[1:] = np.diff(moments) > 0
        at_moments = Trajectory.from_matrices(
            moments[distinct].tolist(), list(T_map_scans[order][distinct])
        )
        stamps = np.unique(np.array([record.stamp_ns for record in records], dtype=np.int64))
        return at_moments.before(stamps)

    def poses(self, rows: Rows | None = None) -> Poses:
        """All present poses at once, or those of some ``records``.

        Raises ValueError before the first scan.
        """
        if not self.records:
            raise ValueError("no scan has been taken in yet, so there is no trajectory")
        wanted = np.arange(len(self.records)) if rows is None else rows
        T_map_scans = self.T_map_scans()[wanted]
        return Poses(T_map_scans, self.T_map_nodes(), self._at_stamps(T_map_scans, wanted))

    def scans(self, poses: Poses, rows: Rows | None = None) -> ScanStore:
        """All scans and views taken in, as the map is drawn from them, or those of some
        ``records`` and the views between them."""
        wanted = range(len(self.records)) if rows is None else rows.tolist()
        views = {view.sensor for view in self.fusing.views}
        records = [
            replace(record, points_base=record.points_base[:0])
            if record.sensor in views
            else record
            for record in (self.records[row] for row in wanted)
        ]
        return scan_store(
            records,
            self.fusing.origins_base(),
            poses,
            self.fusing.layer_names(),
            [self._on_time(view) for view in self._views_among(rows)],
        )

    def _views_among(self, rows: Rows | None) -> list[ViewRecord]:
        """The views whose scan before and scan after are both among some ``records``."""
        if rows is None:
            return self.fusing.views
        stamps = np.array([record.stamp_ns for record in self.records], dtype=np.int64)
        among = np.zeros(len(stamps) + 2, dtype=bool)
        among[rows + 1] = True
        after = [np.searchsorted(stamps, view.stamp_ns) for view in self.fusing.views]
        return [
            view
            for view, k in zip(self.fusing.views, after, strict=True)
            if among[k] and among[k + 1]
        ]

    def _on_time(self, view: ViewRecord) -> ViewRecord:
        clock = self.view_clocks.get(view.sensor)
        if clock is None:
            return view
        return replace(view, stamp_ns=view.stamp_ns + round(clock.offset_s * 1e9))

    def map(self) -> LayeredMap:
        """The map of what was taken in so far, drawn at the present poses."""
        poses = self.poses()
        return draw_map(self.scans(poses), poses.trajectory, self.config.map)

    def graph(self) -> PoseGraphFile:
        """The nodes at their present poses, with what joins them.

        Before the final passes these are local SLAM's steps; after, what they optimised (there
        under a Huber loss): the steps, the closures, and matches of scans with scans.
        """
        constraints = steps_between(self.nodes)
        if self.finished is not None:
            constraints = joined(self.finished.refined.held, self.finished.refined.pairs)
        numbers = np.array([node.index for node in self.nodes], dtype=np.int64)
        return PoseGraphFile(numbers, xyyaw_rows(self.T_map_nodes()), constraints)

    def finish(self) -> None:
        """No more scans come: close the graph and bring everything to its final pose."""
        for leap in self._leaps.values():
            leap.end()
        self.flush()
        self._ended = True
        last = self.local.keeper.finish()
        if last is not None and self.config.loops:
            self.global_slam.add_submap(last)
        if self.config.loops and self.submaps:
            started = time.perf_counter()
            self.finished = finish(self.global_slam, self.nodes, self.submaps, self.config.refine)
            self.nodes[:] = self.finished.refined.nodes
            self._remount()
            self._set_view_clocks()
            self.seconds["final passes"] += time.perf_counter() - started

    def _set_view_clocks(self) -> None:
        """Find out which sensors of views are stamped early or late against the scans."""
        by_sensor: dict[str, list[ViewRecord]] = {}
        for view in self.fusing.views:
            by_sensor.setdefault(view.sensor, []).append(view)
        if not by_sensor or self.config.sensors != "fused":
            return
        trajectory = self.trajectory()
        for sensor, views in by_sensor.items():
            clock = view_clock(views, trajectory)
            if clock is not None:
                self.view_clocks[sensor] = clock

    def _remount(self) -> None:
        """Move the scans of sensors that stand elsewhere than said, or whose clocks are off."""
        offsets = self.finished.refined.offsets if self.finished is not None else ()
        by_lidar = {offset.sensor: offset for offset in offsets}
        for offset in offsets:
            self.fusing.remount(offset.sensor, offset.T_true_said, offset.clock_s)
        for row, record in enumerate(self.records):
            if record.sensor in by_lidar:
                found = by_lidar[record.sensor]
                points = transform(found.T_true_said, record.points_base.astype(np.float64))
                self.records[row] = replace(
                    record,
                    moment_ns=record.moment_ns + round(found.clock_s * 1e9),
                    points_base=points.astype(np.float32),
                    T_odom_base=record.T_odom_base @ inverse(found.T_true_said),
                )
