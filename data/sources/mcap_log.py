"""MCAP drive logs: camera frames, each with the speed at which it was taken.

In: a log, or a folder of them (*.mcap, as ROS 2 and Foxglove record them; mcap.dev). Out: a `Seen`
for each frame taken, by log time and change as in a video; all frames of one file are one scene.

    camera  cdr: sensor_msgs/msg/CompressedImage; json: foxglove.CompressedImage
    speed   cdr: nav_msgs/msg/Odometry, geometry_msgs/msg/TwistStamped, geometry_msgs/msg/Twist
            (x is ahead), std_msgs/msg/Float32 or Float64 [m/s];
            json: a number `speed_mps` or `data` [m/s], or a `twist`

A file is read from its beginning to its end, without its index: a damaged chunk then costs no
other, and of a log that breaks off all is kept that stands before.
"""

import base64
import json
import logging
import math
import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory

from ridetune.sample import Condition, Observation
from ridetune.vision import decode_frame

from .picking import Picker
from .seen import Facts, Frames, Seen, Skipped

ENDING = ".mcap"
ROS_CAMERA = ("sensor_msgs/msg/CompressedImage",)
JSON_CAMERA = ("foxglove.CompressedImage",)
ROS_SPEED = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/Twist",
    "std_msgs/msg/Float32",
    "std_msgs/msg/Float64",
)

# An older speed says nothing of a frame [ns].
_STALE_NS = 1_000_000_000
# Enough for a thumbnail, and to find a JPEG that breaks off.
_GLANCE_PX = (128, 72)
# What the libraries raise on bytes that are not what they should be.
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    RuntimeError,  # of lz4, and what they have not implemented
    ValueError,
    LookupError,
    OverflowError,
    MemoryError,  # a damaged length
)

log = logging.getLogger(__name__)


class McapFile:
    """One file, read in its own order; `damage` says what could not be read so far, in words."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str | None = None
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._ros = DecoderFactory()

    def topics(self) -> list[tuple[Channel, Schema | None]]:
        """Its channels with their schemas; from the summary, or where there is none by reading."""
        try:
            with self.path.open("rb") as file:
                summary = make_reader(file).get_summary()
        except (*_DAMAGE, OSError):  # too short to seek from its end
            summary = None
        if summary is not None:
            self._schemas, self._channels = dict(summary.schemas), dict(summary.channels)
        if not self._channels:
            for _ in self._messages():
                pass
        channels = sorted(self._channels.values(), key=lambda channel: channel.topic)
        return [(channel, self._schemas.get(channel.schema_id)) for channel in channels]

    def messages(self, topic: str) -> Iterator[Message]:
        """Every message of a topic, undecoded."""
        for message in self._messages():
            channel = self._channels.get(message.channel_id)
            if channel is None:
                self._note(f"nothing says what channel {message.channel_id} is")
            elif channel.topic == topic:
                yield message

    def decode(self, message: Message) -> Any:
        """A message of `messages` as an object or as a dict; ValueError if it is damaged."""
        channel = self._channels[message.channel_id]
        schema = self._schemas.get(channel.schema_id)
        try:
            if channel.message_encoding == "json":
                return json.loads(message.data)
            decode = self._ros.decoder_for(channel.message_encoding, schema)
            if decode is None:
                raise ValueError("its encoding is not known")
            return decode(message.data)
        except Exception as error:  # the parser of ROS definitions has its own, of no common base
            raise ValueError(f"the message cannot be decoded: {error}") from error

    def _messages(self) -> Iterator[Message]:
        with self.path.open("rb") as file:
            # No record is larger than its file, whatever a damaged length says.
            limit = self.path.stat().st_size
            records = StreamReader(file, emit_chunks=True, record_size_limit=limit).records
            try:
                for record in records:
                    yield from self._learn(self._inside(record))
            except _DAMAGE as error:
                self._note(_in_words(error))

    def _inside(self, record: McapRecord) -> list[McapRecord]:
        if not isinstance(record, Chunk):
            return [record]
        try:
            return breakup_chunk(record, validate_crc=True)
        except _DAMAGE as error:
            self._note(_in_words(error))
            return []

    def _learn(self, records: list[McapRecord]) -> Iterator[Message]:
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message):
                yield record

    def _note(self, damage: str) -> None:
        self.damage = self.damage or damage


@dataclass(frozen=True)
class _Drive:
    """A file and the topics to read; camera is None where damage has left no camera."""

    file: McapFile
    scene: str
    camera: str | None
    speed: str | None


def read_mcap(
    root: Path,
    *,
    camera: str | None,
    speed: str | None,
    every_s: float = 0.5,
    change: float = 6.0,
    condition: Condition | None = None,
) -> Frames:
    """Frames at least every_s [s] apart, whose thumbnails differ by `change` of 255 on average.

    camera, speed: their topics; None is the only one of a fitting schema. Without a speed topic,
    and where its last message is older than a second, the speed is unknown. ValueError where there
    is no log, no camera, or no telling which of several topics is meant.
    """
    paths = [root] if root.is_file() else sorted(root.rglob(f"*{ENDING}"))
    if not paths:
        raise ValueError(f"{root} holds no {ENDING}; name a drive log or a folder of them")
    # All of them before the first frame: a wrong topic is not found out after an hour.
    drives = [_drive_of(root, McapFile(path), camera, speed) for path in paths]
    for drive in drives:
        yield from _frames_of(drive, every_s, change, condition)


def _drive_of(root: Path, file: McapFile, camera: str | None, speed: str | None) -> _Drive:
    topics = file.topics()
    found = _choose(file, topics, "camera", camera, _is_camera)
    if found is None and file.damage is None:
        raise ValueError(
            f"{file.path} has no camera topic ({', '.join(ROS_CAMERA + JSON_CAMERA)}); "
            f"it has {_listed(topics)}; set camera=... if one of them is"
        )
    scene = file.path.name if root.is_file() else file.path.relative_to(root).as_posix()
    return _Drive(file, scene, found, _choose(file, topics, "speed", speed, _is_speed))


def _choose(
    file: McapFile,
    topics: list[tuple[Channel, Schema | None]],
    key: str,
    named: str | None,
    fits: Callable[[Channel, Schema | None, bool], bool],
) -> str | None:
    """The topic that is named, or the only one that fits; None if none fits."""
    fitting = sorted({c.topic for c, schema in topics if fits(c, schema, c.topic == named)})
    if named is not None:
        if named in fitting:
            return named
        if file.damage is not None:  # it may be in what is lost
            return None
        raise ValueError(
            f"{file.path} has no topic {named!r} of a known {key} schema; "
            f"it has {_listed(topics)}; set {key}=... to one of them"
        )
    if len(fitting) > 1:
        raise ValueError(
            f"{file.path} has several {key} topics: {', '.join(fitting)}; set {key}=... to one"
        )
    return fitting[0] if fitting else None


def _listed(topics: list[tuple[Channel, Schema | None]]) -> str:
    lines = [
        f"{channel.topic} ({schema.name if schema else 'no schema'}, {channel.message_encoding})"
        for channel, schema in topics
    ]
    return ", ".join(lines) or "no topic at all"


def _is_camera(channel: Channel, schema: Schema | None, named: bool) -> bool:
    if channel.message_encoding == "json":
        return named or (schema is not None and schema.name in JSON_CAMERA)
    return _is_ros(channel, schema, ROS_CAMERA)


def _is_speed(channel: Channel, schema: Schema | None, named: bool) -> bool:
    if channel.message_encoding == "json":
        return named or (schema is not None and _has_speed(schema))
    return _is_ros(channel, schema, ROS_SPEED)


def _is_ros(channel: Channel, schema: Schema | None, names: tuple[str, ...]) -> bool:
    if schema is None or channel.message_encoding != "cdr" or schema.encoding != "ros2msg":
        return False
    return schema.name in names


def _has_speed(schema: Schema) -> bool:
    """Whether a JSON schema promises a field of which the speed can be read."""
    try:
        fields = json.loads(schema.data)["properties"]
        kinds = {name: field.get("type") for name, field in fields.items()}
    except (*_DAMAGE, TypeError, AttributeError):
        return False
    numbers = {name for name, kind in kinds.items() if kind in ("number", "integer")}
    return bool(numbers & {"speed_mps", "data"}) or "twist" in kinds


def _frames_of(drive: _Drive, every_s: float, change: float, condition: Condition | None) -> Frames:
    file, taken = drive.file, 0
    if drive.camera is not None:
        speeds = _speeds_of(drive)
        picker = Picker(change)
        for number, message in _apart(file.messages(drive.camera), every_s):
            name = f"{drive.scene}/{number:06d}"
            picture = _picture_of(file, message, name, picker)
            if isinstance(picture, bytes):
                taken += 1
                observation = Observation(picture, _speed_at(speeds, message.log_time))
                yield Seen(name, drive.scene, observation, Facts(condition=condition))
            elif picture is not None:
                yield picture
    log.info("log=%s camera=%s speed=%s frames=%d", file.path, drive.camera, drive.speed, taken)
    if file.damage is not None:
        yield Skipped(drive.scene, f"damaged: {file.damage}; {taken} frames were kept")
    elif not taken:
        yield Skipped(drive.scene, f"{drive.camera} holds no frame that can be read")


def _apart(messages: Iterator[Message], every_s: float) -> Iterator[tuple[int, Message]]:
    """The messages that are far enough apart in log time, with their numbers."""
    last_ns: int | None = None
    for number, message in enumerate(messages):
        # Either way: a clock that was set back must not end the drive.
        if last_ns is None or abs(message.log_time - last_ns) >= every_s * 1e9:
            last_ns = message.log_time
            yield number, message


def _picture_of(
    file: McapFile, message: Message, name: str, picker: Picker
) -> bytes | Skipped | None:
    """The encoded picture of a message, what is wrong with it, or None if it is nothing new."""
    try:
        picture = _encoded(file.decode(message))
        pixels = decode_frame(picture, _GLANCE_PX)
    except ValueError as error:
        return Skipped(name, str(error))
    return picture if picker.takes(np.ascontiguousarray(pixels[..., ::-1])) else None


def _encoded(message: Any) -> bytes:
    data = _field(message, "data")
    if isinstance(data, str):
        return base64.b64decode(data, validate=True)
    if isinstance(data, bytes):
        return data
    raise ValueError("the message has no picture in its field `data`")


def _speeds_of(drive: _Drive) -> list[tuple[int, float]]:
    """Log times [ns] and speeds [m/s], by time."""
    speeds, unread = [], 0
    for message in drive.file.messages(drive.speed) if drive.speed is not None else ():
        try:
            speed = _speed_in(drive.file.decode(message))
        except (ValueError, OverflowError):  # a whole number of JSON has no bound
            speed = None
        if speed is None:
            unread += 1
        else:
            speeds.append((message.log_time, speed))
    if unread:
        log.warning("log=%s topic=%s unread=%d", drive.file.path, drive.speed, unread)
    return sorted(speeds)


def _speed_in(message: Any) -> float | None:
    """Its magnitude [m/s], also when reversing; None if the message does not say."""
    while (twist := _field(message, "twist")) is not None:
        message = twist
    forward = _field(_field(message, "linear"), "x")
    for value in (_field(message, "speed_mps"), _field(message, "data"), forward):
        if isinstance(value, int | float) and not isinstance(value, bool):
            return abs(float(value)) if math.isfinite(value) else None
    return None


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _speed_at(speeds: list[tuple[int, float]], time_ns: int) -> float | None:
    """The newest speed at that time; None if it is too old."""
    after = bisect_right(speeds, time_ns, key=lambda known: known[0])
    if after == 0 or time_ns - speeds[after - 1][0] > _STALE_NS:
        return None
    return speeds[after - 1][1]


def _in_words(error: BaseException) -> str:
    if isinstance(error, EndOfFile):
        return "the log breaks off"
    return str(error) or type(error).__name__
