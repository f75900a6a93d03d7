"""Which topics of a bag are lidars, odometry and ground truth: found by type, chosen by option."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

from datasets.bag_messages import LASER_SCAN, ODOMETRY, POSE_TYPES, RosMessage, framed_pose
from datasets.bag_parts import Topic
from datasets.bag_records import RawMessage
from datasets.bag_source import BagSource, CorruptMessageError, decode
from datasets.errors import InputError
from datasets.tf_tree import frame_name

_TRUTH = re.compile(r"(?i)ground_?truth|(^|[/_])(gt|mocap|vicon|optitrack|vrpn)([/_]|$)")
"""Names under which people record the true pose."""

_NOT_WHEELS = re.compile(r"(?i)camera|visual|vio|icp|lidar|laser|slam|loam|amcl|map|gps|global")
"""Names of odometry made from other things than wheels; taken only if there is no other."""

MOST_SENSORS = 30
_FIRST = 5
"""How many scans of a lidar are looked at to know it."""


class LidarTopic(NamedTuple):
    """A lidar: its topic, its frame in tf, and when its first scan was recorded."""

    topic: str
    frame: str
    first_bag_ns: int


def topic_named(source: BagSource, name: str, msgtypes: Sequence[str], option: str) -> Topic:
    """The topic somebody asked for, with or without its leading slash.

    Raises InputError that lists what could have been meant.
    """
    topic = source.topics.get(name if name.startswith("/") else f"/{name}")
    if topic is None or topic.msgtype not in msgtypes:
        what = "no such topic" if topic is None else f"a topic of type {topic.msgtype}"
        fitting = ", ".join(t.name for t in source.of_type(*msgtypes))
        raise InputError(
            what,
            where=f"{source.where}, topic {name}",
            remedy=f"`{option}` can be: {fitting or 'none of the topics in this recording'}",
        )
    return topic


def find_lidars(
    source: BagSource, asked: Sequence[str], notes: Counter[str], *, required: bool = True
) -> list[LidarTopic]:
    """The lidars that were asked for, or all; by topic name.

    Nobody having asked, a topic that repeats another's scans (filtered, or relayed) is left out.
    Raises InputError if there is none of that name, or, if one is ``required``, none at all.
    """
    scans = source.of_type(LASER_SCAN)
    if not scans and not asked and not required:
        return []
    if not scans:
        raise InputError(
            f"no lidar in the recording, that is no {LASER_SCAN}; there is: {source.listing()}",
            where=source.where,
            remedy="Record the topic of a 2D lidar",
        )
    chosen = [topic_named(source, name, (LASER_SCAN,), "--lidar") for name in asked] or scans
    if len(chosen) > MOST_SENSORS:
        raise InputError(
            f"there are {len(chosen)} topics of lidars",
            where=source.where,
            remedy=f"Choose those of one robot with `--lidar TOPIC`, {MOST_SENSORS} at most",
        )
    lidars: dict[str, LidarTopic] = {}
    seen: dict[tuple[str, int, int], str] = {}
    for topic in sorted(chosen, key=lambda topic: (len(topic.name), topic.name)):
        first = list(islice(decoded(source, topic), _FIRST))
        if not first:
            notes[f"{topic.name} left out: none of its messages can be decoded"] = topic.count
            continue
        headers = [message.header for _, message in first]
        frame = frame_name(headers[0].frame_id)
        keys = [(frame, h.stamp.sec, h.stamp.nanosec) for h in headers]
        twin = next((seen[key] for key in keys if key in seen and key[1:] != (0, 0)), None)
        if twin is not None and not asked:
            notes[f"{topic.name} left out: it repeats the scans of {twin}"] = topic.count
            continue
        seen.update(dict.fromkeys(keys, topic.name))
        lidars[topic.name] = LidarTopic(topic.name, frame, first[0][0].bag_ns)
    if not lidars and (asked or required):
        raise InputError(
            f"no scan of {', '.join(topic.name for topic in chosen)} can be decoded",
            where=source.where,
            remedy="Record the lidar again, or choose another with `--lidar TOPIC`",
        )
    return [lidars[name] for name in sorted(lidars)]


def find_ground_truth(source: BagSource, asked: str | None) -> Topic | None:
    """The topic that was asked for, or the first one of poses whose name says it is the truth."""
    if asked is not None:
        return topic_named(source, asked, POSE_TYPES, "--ground-truth")
    return next((t for t in source.of_type(*POSE_TYPES) if _TRUTH.search(t.name)), None)


def find_odometry(
    source: BagSource, asked: str | None, truth: Topic | None, notes: Counter[str]
) -> Topic | None:
    """The topic that was asked for, or the one of type Odometry that looks most like wheels.

    truth : what is taken as ground truth is not taken as odometry too, unless asked for.
    """
    if asked is not None:
        return topic_named(source, asked, POSE_TYPES, "--odometry")
    found = [t for t in source.of_type(ODOMETRY) if t != truth and not _TRUTH.search(t.name)]
    if not found:
        return None
    best, *others = sorted(found, key=_wheel_rank)
    if others:
        names = ", ".join(topic.name for topic in others)
        notes[f"odometry taken from {best.name}, not from {names} (`--odometry` chooses)"] = 1
    return best


def _wheel_rank(topic: Topic) -> tuple[bool, bool, int, str]:
    last = topic.name.rpartition("/")[2]
    return bool(_NOT_WHEELS.search(topic.name)), last != "odom", len(topic.name), topic.name


def child_frame(source: BagSource, topic: Topic) -> str:
    """The frame whose pose a topic tells; "" where it doesn't say."""
    for _, message in islice(decoded(source, topic), _FIRST):
        try:
            return framed_pose(message).child
        except ValueError:
            continue
    return ""


def decoded(source: BagSource, topic: Topic) -> Iterator[tuple[RawMessage, RosMessage]]:
    """The messages of one topic that can be decoded."""
    for raw in source.messages((topic.name,)):
        try:
            yield raw, decode(raw)
        except CorruptMessageError:
            continue
