"""Depth images on their way through the order of time: few bytes wait, and no wrong clocks."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from datasets.bag_depth import BadImageError, depth_m
from datasets.bag_messages import RosMessage
from datasets.bag_salvage import RawMessage
from datasets.bag_source import CorruptMessageError, decode
from datasets.messages import DepthImage, LaserScan, Odometry
from datasets.recording import CameraCalibration
from datasets.time_order import SAME_TIME_NS, WINDOW

HELD_BYTES = 128 * 2**20
"""So much of images waits in memory for the other sensors; what is more is read a second time."""


@dataclass(frozen=True, slots=True)
class WaitingImage:
    """A depth image as it lies in the bag, not yet decoded.

    index, bag_ns : the how manieth message of its topic it is, from 0, and when it was recorded.
    message       : None if it is to be read again.
    """

    stamp_ns: int
    camera: str
    index: int
    bag_ns: int
    message: RosMessage | None


Arriving = LaserScan | Odometry | WaitingImage


class ImageStore:
    """Keeps the images that wait for their turn, and decodes them when it comes.

    cameras : what the images must fit.
    again   : the messages of a topic from the beginning, in the same order as they came first.
    notes   : counts images that are left out.

    Memory: HELD_BYTES, however long the images wait.
    """

    def __init__(
        self,
        cameras: dict[str, CameraCalibration],
        again: Callable[[str], Iterator[RawMessage]],
        notes: Counter[str],
    ) -> None:
        self._cameras = cameras
        self._again = again
        self._notes = notes
        self._arrived: Counter[str] = Counter()
        self._held: dict[str, deque[tuple[int, int]]] = {name: deque() for name in cameras}
        self._held_bytes = 0
        self._second: dict[str, Iterator[tuple[int, RawMessage]]] = {}

    def arrived(self, camera: str) -> int:
        """Count a message of a camera, whatever becomes of it; gives its index."""
        self._arrived[camera] += 1
        return self._arrived[camera] - 1

    def waiting(
        self, message: RosMessage, raw: RawMessage, *, stamp_ns: int, index: int
    ) -> WaitingImage:
        """Let an image wait, with its bytes if there is room for them."""
        size = len(raw.data)
        if self._held_bytes + size > HELD_BYTES:
            message = None
        else:
            self._held[raw.topic].append((index, size))
            self._held_bytes += size
        return WaitingImage(stamp_ns, raw.topic, index, raw.bag_ns, message)

    def developed(self, image: WaitingImage) -> DepthImage | None:
        """The image in metres, its turn having come; None and a note if it can't be used.

        Those of one camera have their turn in the order in which they came.
        """
        self._release(image.camera, image.index)
        name = image.camera
        try:
            message = self._read_again(image) if image.message is None else image.message
            depth = depth_m(message)
            wanted = self._cameras[name].intrinsics
            height_px, width_px = depth.shape
            if wanted is not None and (wanted.width_px, wanted.height_px) != (width_px, height_px):
                raise BadImageError(
                    f"it has {width_px} x {height_px} pixels, its intrinsics are for "
                    f"{wanted.width_px} x {wanted.height_px}"
                )
        except BadImageError as error:
            self._notes[f"image of {name} left out: {error}"] += 1
            return None
        if not (depth > 0.0).any():
            self._notes[f"image of {name}: depth image without one measurement"] += 1
        return DepthImage(image.stamp_ns, name, depth)

    def _release(self, camera: str, index: int) -> None:
        """Forget the bytes of an image and of those before it, which were left out."""
        held = self._held[camera]
        while held and held[0][0] <= index:
            self._held_bytes -= held.popleft()[1]

    def _read_again(self, image: WaitingImage) -> RosMessage:
        second = self._second.get(image.camera)
        if second is None:
            second = self._second[image.camera] = enumerate(self._again(image.camera))
        raw = next((raw for index, raw in second if index == image.index), None)
        if raw is None or raw.bag_ns != image.bag_ns:
            raise BadImageError("it can't be read a second time")
        try:
            return decode(raw)
        except CorruptMessageError as error:
            raise BadImageError("it can't be decoded") from error


@dataclass(slots=True)
class CameraClocks:
    """Keeps images of another time out of the stream: it would wait for them, or they for it.

    alone : there is nothing but cameras, and no clock to compare with.
    """

    notes: Counter[str]
    alone: bool
    _others_ns: deque[int] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _early: list[tuple[str, WaitingImage]] = field(default_factory=list)

    def passed(self, stream: str, message: Arriving) -> Iterable[tuple[str, Arriving]]:
        """The messages, by stream, that can be put in order now that this one has come."""
        if isinstance(message, WaitingImage):
            if self.alone or self._fits(message):
                yield stream, message
            elif not self._others_ns:
                self._early.append((stream, message))
            else:
                self._leave_out(stream)
            return
        self._others_ns.append(message.stamp_ns)
        yield from self._released()
        yield stream, message

    def rest(self) -> Iterable[tuple[str, Arriving]]:
        """What waited for another sensor that never came."""
        yield from self._early

    def _released(self) -> Iterator[tuple[str, Arriving]]:
        early, self._early = self._early, []
        for stream, image in early:
            if self._fits(image):
                yield stream, image
            else:
                self._leave_out(stream)

    def _fits(self, image: WaitingImage) -> bool:
        return any(abs(image.stamp_ns - other_ns) <= SAME_TIME_NS for other_ns in self._others_ns)

    def _leave_out(self, stream: str) -> None:
        self.notes[
            f"{stream} left out: its stamp is more than {SAME_TIME_NS / 1e9:g} s away from those "
            "of the other sensors (`clock_offset_s` in the calibration file moves it)"
        ] += 1
