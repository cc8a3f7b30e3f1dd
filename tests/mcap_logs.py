"""MCAP drive logs as a recorder of ROS 2 or a writer of JSON leaves them."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as RosWriter

SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS

HEADER = """\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
TWIST = """\
================================================================================
MSG: geometry_msgs/Twist
Vector3 linear
Vector3 angular
"""
VECTOR = """\
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
ODOMETRY = """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
================================================================================
MSG: geometry_msgs/PoseWithCovariance
Pose pose
float64[36] covariance
================================================================================
MSG: geometry_msgs/Pose
Point position
Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
================================================================================
MSG: geometry_msgs/TwistWithCovariance
Twist twist
float64[36] covariance
"""
IMAGE = "std_msgs/Header header\nstring format\nuint8[] data\n"
STAMPED = "std_msgs/Header header\nTwist twist\n"
# As the recorder of ROS 2 writes them.
ROS = {
    "sensor_msgs/msg/CompressedImage": IMAGE + HEADER,
    "nav_msgs/msg/Odometry": ODOMETRY + HEADER + TWIST + VECTOR,
    "geometry_msgs/msg/TwistStamped": STAMPED + HEADER + TWIST + VECTOR,
    "geometry_msgs/msg/Twist": "Vector3 linear\nVector3 angular\n" + VECTOR,
    "std_msgs/msg/Float32": "float32 data\n",
    "std_msgs/msg/Float64": "float64 data\n",
    "std_msgs/msg/String": "string data\n",
}
CAMERA, SPEED = "sensor_msgs/msg/CompressedImage", "std_msgs/msg/Float64"


@dataclass(frozen=True)
class Said:
    """One message of a log."""

    time_s: float
    topic: str
    kind: str
    content: dict[str, Any]


def image(time_s: float, picture: bytes, topic: str = "/front") -> Said:
    return Said(time_s, topic, CAMERA, {"format": "jpeg", "data": picture})


def speed(time_s: float, value: float, topic: str = "/speed") -> Said:
    return Said(time_s, topic, SPEED, {"data": value})


def write_ros(path: Path, *said: Said, chunk_size: int = 1024, **options: Any) -> Path:
    """A log of ROS 2, in the order given, with about one picture in a chunk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer: Any = RosWriter(file, chunk_size=chunk_size, **options)
        schemas = {s.kind: writer.register_msgdef(s.kind, ROS[s.kind]) for s in said}
        for s in said:
            time_ns = START_NS + round(s.time_s * SECOND_NS)
            writer.write_message(s.topic, schemas[s.kind], s.content, log_time=time_ns)
        writer.finish()
    return path


def write_json(path: Path, *said: Said, **options: Any) -> Path:
    """A log of JSON messages whose schemas name the fields of the first message of a topic."""
    with path.open("wb") as file:
        writer: Any = McapWriter(file, **options)
        writer.start()
        channels: dict[str, int] = {}
        for s in said:
            if s.topic not in channels:
                fields = {name: {"type": json_type(value)} for name, value in s.content.items()}
                schema = json.dumps({"type": "object", "properties": fields}).encode()
                number = writer.register_schema(s.kind, "jsonschema", schema)
                channels[s.topic] = writer.register_channel(s.topic, "json", number)
            data = json.dumps(s.content).encode()
            time_ns = START_NS + round(s.time_s * SECOND_NS)
            writer.add_message(channels[s.topic], time_ns, data, time_ns)
        writer.finish()
    return path


def json_type(value: Any) -> str:
    return {str: "string", float: "number", int: "integer", dict: "object"}[type(value)]


def json_image(time_s: float, picture: bytes, topic: str = "/front") -> Said:
    data = base64.b64encode(picture).decode()
    return Said(time_s, topic, "foxglove.CompressedImage", {"format": "jpeg", "data": data})
