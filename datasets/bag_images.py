"""Depth images on their way through the order of time: few bytes wait, and no wrong clocks."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from datasets.bag_depth import BadImageError, depth_format, depth_m
from datasets.bag_messages import RosMessage
from datasets.bag_records import RawMessage
from datasets.bag_source import CorruptMessageError, decode
from datasets.messages import DepthImage, LaserScan, Odometry
from datasets.recording import CameraCalibration
from datasets.time_order import SAME_TIME_NS, WINDOW

HELD_BYTES = 128 * 2**20
"""So much of images waits in memory for the other sensors; what is more is read a second time."""

APART_NS = 1_000_000_000
"""Stamps that differ by more, of what was recorded at one moment, are of two clocks."""


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
    pixels  : so many may be decoded, in all.

    Memory: HELD_BYTES, however long the images wait.
    """

    def __init__(
        self,
        cameras: dict[str, CameraCalibration],
        again: Callable[[str], Iterator[RawMessage]],
        notes: Counter[str],
        pixels: int,
    ) -> None:
        self._pixels = pixels
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
            form = depth_format(message)
            self._pixels -= form.width_px * form.height_px
            if self._pixels < 0:
                raise BadImageError("there are far more pixels than the recording can hold")
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

    Two clocks that are seconds apart show only in when the messages were recorded: what is stamped
    alike was recorded at nearly one moment. Without them such images would be laid on the map
    where the robot was at another time.

    alone : there is nothing but cameras, and no clock to compare with.
    """

    notes: Counter[str]
    alone: bool
    _others: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    """Stamps of the last messages of other sensors, and how much later they were recorded."""
    _early: list[tuple[str, WaitingImage]] = field(default_factory=list)
    _reasons: dict[str, str] = field(default_factory=dict)
    """By stream, how far its clock is off: as found first, so that all images count as one note."""

    def passed(self, stream: str, message: Arriving, bag_ns: int) -> Iterable[tuple[str, Arriving]]:
        """The messages, by stream, that can be put in order now that this one has come."""
        if isinstance(message, WaitingImage):
            if not self.alone and not self._others:
                self._early.append((stream, message))
            elif self._fits(stream, message):
                yield stream, message
            return
        self._others.append((message.stamp_ns, bag_ns - message.stamp_ns))
        yield from self._released()
        yield stream, message

    def rest(self) -> Iterable[tuple[str, Arriving]]:
        """What waited for another sensor that never came."""
        yield from self._early

    def _released(self) -> Iterator[tuple[str, Arriving]]:
        early, self._early = self._early, []
        for stream, image in early:
            if self._fits(stream, image):
                yield stream, image

    def _fits(self, stream: str, image: WaitingImage) -> bool:
        """Whether the image is of the others' time; else it is counted as left out."""
        if self.alone:
            return True
        if all(abs(image.stamp_ns - other_ns) > SAME_TIME_NS for other_ns, _ in self._others):
            reason = (
                f"its stamp is more than {SAME_TIME_NS / 1e9:g} s away from those of the other "
                "sensors (`clock_offset_s` in the calibration file moves it)"
            )
            self.notes[f"{stream} left out: {reason}"] += 1
            return False
        late_ns = image.bag_ns - image.stamp_ns
        ahead_ns = min((other_ns - late_ns for _, other_ns in self._others), key=abs)
        if abs(ahead_ns) <= APART_NS:
            return True
        reason = self._reasons.setdefault(stream, _clock_reason(ahead_ns * 1e-9))
        self.notes[f"{stream} left out: {reason}"] += 1
        return False


def _clock_reason(ahead_s: float) -> str:
    return (
        f"stamped {abs(ahead_s):.1f} s {'later' if ahead_s > 0.0 else 'earlier'} than what other "
        f"sensors saw when it was recorded (`clock_offset_s: {-ahead_s:.1f}` in the calibration "
        "file moves it)"
    )
