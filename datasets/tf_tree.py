"""The tf tree of a bag: which frame hangs on which, and how one stands in another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datasets.bounds import FARTHEST_M, within
from datasets.errors import one_line
from datasets.messages import Array
from datasets.se2 import se2, yaw_rad

# A mounting that moves by less than this is a mounting: joint encoders jitter.
MOVES_M = 0.005
MOVES_RAD = 0.01


_LONGEST_NAME = 200
MOST_FRAMES = 5000
DEEPEST = 200
"""Frames that a tree takes in, and links between a frame and its root that are followed."""


def se3(xyz_m: Sequence[float], quaternion_xyzw: Sequence[float]) -> Array:
    """The (4, 4) matrix T_a_b of a frame b at xyz in a, turned by a quaternion.

    The quaternion need not be of unit length. Raises ValueError if a value is not finite, or not
    of this world, or if the quaternion is zero.
    """
    norm = math.sqrt(sum(part * part for part in quaternion_xyzw))
    if not (math.isfinite(norm) and within(xyz_m, FARTHEST_M)):
        raise ValueError("a transform must be finite")
    if norm < 1e-6:
        raise ValueError("a rotation must not be the zero quaternion")
    x, y, z, w = (part / norm for part in quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), xyz_m[0]],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), xyz_m[1]],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), xyz_m[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def se3_inverse(T_a_b: Array) -> Array:
    """T_b_a of a (4, 4) rigid transform."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def planar(T_a_b: Array) -> Array:
    """The (3, 3) planar pose of a (4, 4) one: x, y, and where b's x axis points seen from above."""
    return se2(T_a_b[0, 3], T_a_b[1, 3], yaw_rad(T_a_b))


def standing(xyyaw: Array) -> Array:
    """The (4, 4) pose of a base that stands on the floor, at (3,) x m, y m, yaw rad."""
    x_m, y_m, yaw = xyyaw.tolist()
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)


def frame_name(name: str) -> str:
    """ROS 1 bags write frames with and without a leading slash and mean the same.

    Printable, since it stands in notes and errors.
    """
    name = name.strip().lstrip("/")
    is_plain = name.isprintable() and len(name) <= _LONGEST_NAME
    return name if is_plain else one_line(name, _LONGEST_NAME)


@dataclass(slots=True)
class Edge:
    """A frame on its parent. T_parent_child : (4, 4), as first seen; moves: it changed since."""

    parent: str
    T_parent_child: Array
    moves: bool = False


class TfTree:
    """Frames by their parents. The first parent and the first pose of a frame are kept."""

    def __init__(self) -> None:
        self.edges: dict[str, Edge] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self.edges or any(edge.parent == frame for edge in self.edges.values())

    def add(self, parent: str, child: str, T_parent_child: Array) -> bool:
        """Put a frame on its parent; False if it has another parent already or is its own.

        Raises ValueError if there are too many.
        """
        if parent == child:
            return False
        edge = self.edges.get(child)
        if edge is None:
            if len(self.edges) >= MOST_FRAMES:
                raise ValueError(f"there are more than {MOST_FRAMES} frames")
            self.edges[child] = Edge(parent, T_parent_child)
            return True
        if edge.parent != parent:
            return False
        edge.moves = edge.moves or _moved(edge.T_parent_child, T_parent_child)
        return True

    def upwards(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root (a loop is followed once)."""
        chain = [frame]
        while (edge := self.edges.get(chain[-1])) is not None and edge.parent not in chain:
            if len(chain) > DEEPEST:
                break
            chain.append(edge.parent)
        return chain

    def path(self, a: str, b: str) -> tuple[list[str], list[str]] | None:
        """The frames from a and from b up to (without) where they meet; None if they don't."""
        up_a, up_b = self.upwards(a), self.upwards(b)
        meeting = next((frame for frame in up_a if frame in up_b), None)
        if meeting is None:
            return None
        return up_a[: up_a.index(meeting)], up_b[: up_b.index(meeting)]

    def moves(self, a: str, b: str) -> bool:
        """Whether b was seen to move in a. Raises KeyError if nothing connects them."""
        from_a, from_b = self._connected(a, b)
        return any(self.edges[frame].moves for frame in (*from_a, *from_b))

    def transform(self, a: str, b: str) -> Array:
        """T_a_b, (4, 4), through any number of links, as first seen.

        Raises KeyError if nothing connects them.
        """
        from_a, from_b = self._connected(a, b)
        T_meeting_a, T_meeting_b = np.eye(4), np.eye(4)
        for frame in from_a:
            T_meeting_a = self.edges[frame].T_parent_child @ T_meeting_a
        for frame in from_b:
            T_meeting_b = self.edges[frame].T_parent_child @ T_meeting_b
        T_a_b: Array = se3_inverse(T_meeting_a) @ T_meeting_b
        return T_a_b

    def _connected(self, a: str, b: str) -> tuple[list[str], list[str]]:
        path = self.path(a, b)
        if path is None:
            raise KeyError(f"tf does not connect {a!r} and {b!r}")
        return path


def _moved(T_first: Array, T_now: Array) -> bool:
    turn_cos = (np.trace(T_first[:3, :3].T @ T_now[:3, :3]) - 1.0) / 2.0
    shift_m = np.linalg.norm(T_first[:3, 3] - T_now[:3, 3])
    return bool(shift_m > MOVES_M or turn_cos < math.cos(MOVES_RAD))
