"""Which topics of a bag are depth cameras: found by type and first image, chosen by option."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Final, NamedTuple

from datasets.bag_depth import COMPRESSED_IMAGE, ENCODINGS, IMAGE, BadImageError, depth_format
from datasets.bag_parts import Topic
from datasets.bag_source import BagSource
from datasets.bag_topics import decoded
from datasets.errors import InputError
from datasets.tf_tree import frame_name

IMAGE_TYPES: Final = (IMAGE, COMPRESSED_IMAGE)

_TRANSPORTS: Final = ("raw", "compressedDepth", "png")
"""The best first: where a camera was recorded in several, one is taken."""

_OTHER_KINDS = re.compile(
    r"(?i)^(ir\d*|infra\w*|thermal|amplitude|confidence|intensity|disparity|labels?|mono\d*)$"
)
_DEPTH_KINDS = re.compile(r"(?i)^(\w*depth\w*|range)$")
"""Words of topics of 16 bit images: an infrared image looks just like a depth image."""
_COLOUR = re.compile(r"(?i)(^|[/_])(rgb|colou?r)")
"""Colour images of a device that is called a depth camera."""

MOST_IMAGE_TOPICS = 60
_FIRST = 5
"""How many images of a topic are looked at to know it."""


class CameraTopic(NamedTuple):
    """A depth camera: its topic, the frame of its images, when the first was recorded, their size.

    base_name : the topic without what its transport adds to it.
    stamps    : (sec, nanosec) of the first images.
    """

    topic: str
    frame: str
    first_bag_ns: int
    width_px: int
    height_px: int
    messages: int
    encoding: str
    transport: str
    base_name: str
    stamps: tuple[tuple[int, int], ...]


def find_depth_topics(source: BagSource, notes: Counter[str]) -> dict[str, CameraTopic]:
    """The topics whose images are depth images, by name.

    Topics of other images are passed over in silence, unless their name speaks of depth.
    """
    found: dict[str, CameraTopic] = {}
    images = source.of_type(*IMAGE_TYPES)
    if len(images) > MOST_IMAGE_TOPICS:
        images.sort(key=lambda topic: (_kind_by_name(topic.name) != "depth", topic.name))
        what = f"only {MOST_IMAGE_TOPICS} topics of images are looked at"
        notes[f"{what} (`--camera` takes others)"] = 1
    for topic in images[:MOST_IMAGE_TOPICS]:
        kind = _kind_by_name(topic.name)
        camera = _looked_at(source, topic)
        # mono16 is an encoding of brightness, which some drivers give to depth.
        sure = isinstance(camera, CameraTopic) and camera.encoding != "mono16"
        if isinstance(camera, CameraTopic) and (kind == "depth" or (sure and kind != "other")):
            found[topic.name] = camera
        elif isinstance(camera, CameraTopic):
            notes[
                f"{topic.name} left out: by its name it is no depth image (`--camera` takes it)"
            ] = topic.count
        elif kind == "depth" and not _COLOUR.search(topic.name):
            notes[f"{topic.name} left out: {camera}"] = topic.count
    return found


def choose_cameras(
    source: BagSource,
    found: Mapping[str, CameraTopic],
    asked: Sequence[str],
    notes: Counter[str],
) -> list[CameraTopic]:
    """The cameras that were asked for, or all; by topic name.

    Nobody having asked, a topic that repeats another's images (compressed, rectified, or seen from
    the colour camera) is left out. Raises InputError if one that was asked for is no depth camera.
    """
    if asked:
        chosen = {camera.topic: camera for camera in (_asked(source, found, n) for n in asked)}
        return [chosen[name] for name in sorted(chosen)]
    cameras: list[CameraTopic] = []
    for camera in sorted(found.values(), key=_rank):
        twin = next((other for other in cameras if _repeats(camera, other)), None)
        if twin is None:
            cameras.append(camera)
        else:
            notes[
                f"{camera.topic} left out: it repeats the images of {twin.topic} "
                "(`--camera` takes it)"
            ] = camera.messages
    return sorted(cameras)


def _asked(source: BagSource, found: Mapping[str, CameraTopic], name: str) -> CameraTopic:
    """The topic somebody asked for, with or without its leading slash."""
    topic = source.topics.get(name if name.startswith("/") else f"/{name}")
    if topic is None:
        why = "no such topic"
    elif topic.msgtype not in IMAGE_TYPES:
        why = f"a topic of type {topic.msgtype}"
    else:
        camera = found.get(topic.name) or _looked_at(source, topic)
        if isinstance(camera, CameraTopic):
            return camera
        why = f"no depth camera: {camera}"
    raise InputError(
        why,
        where=f"{source.where}, topic {name}",
        remedy=f"`--camera` can be: {', '.join(found) or 'none of the topics in this recording'}",
    )


def _looked_at(source: BagSource, topic: Topic) -> CameraTopic | str:
    """The camera of a topic by its first images, or why it is none."""
    why, stamps, known = "none of its messages can be decoded", [], None
    for raw, message in islice(decoded(source, topic), _FIRST):
        stamps.append((int(message.header.stamp.sec), int(message.header.stamp.nanosec)))
        if known is not None:
            continue
        try:
            known = raw, message, depth_format(message)
        except BadImageError as error:
            why = str(error)
    if known is None:
        return why
    raw, message, form = known
    base_name = topic.name
    if form.transport != "raw":
        base_name = re.sub(r"/compressed(Depth)?$", "", base_name)
    return CameraTopic(
        topic.name,
        frame_name(message.header.frame_id),
        raw.bag_ns,
        form.width_px,
        form.height_px,
        topic.count,
        form.encoding,
        form.transport,
        base_name,
        tuple(stamps),
    )


def _kind_by_name(topic: str) -> str:
    """What the last telling word of a topic says: "depth", "other" (infrared ..), or ""."""
    for word in reversed(re.split(r"[/_]", topic)):
        if _OTHER_KINDS.search(word):
            return "other"
        if _DEPTH_KINDS.search(word):
            return "depth"
    return ""


def _rank(camera: CameraTopic) -> tuple[bool, int, bool, int, str]:
    """Uncompressed before compressed, rectified before raw, the camera's own view before others."""
    transport = _TRANSPORTS.index(camera.transport)
    name = camera.base_name
    return "aligned" in name, transport, "rect" not in name, len(name), camera.topic


def _repeats(camera: CameraTopic, other: CameraTopic) -> bool:
    if camera.base_name == other.base_name:
        return True
    stamps = {stamp for stamp in camera.stamps if stamp != (0, 0)}
    same_frame = camera.frame == other.frame or "aligned" in camera.base_name
    return same_frame and not stamps.isdisjoint(other.stamps)


def no_camera(source: BagSource) -> InputError:
    """What to say where depth cameras are wanted and there is none."""
    return InputError(
        f"no depth camera in the recording, that is no {IMAGE} of encoding "
        f"{' or '.join(ENCODINGS)}; there is: {source.listing()}",
        where=source.where,
        remedy="Record the topic of a depth camera, or leave lidars in",
    )
