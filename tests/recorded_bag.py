"""A rosbag2 recording of two speeds for tests; it needs the package rosbags."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag2, typesys

MODES = rosbag2.CompressionMode
PLUGINS = rosbag2.StoragePlugin
# a dataset of it in the folder RUN
DATASET = """kind = "recorder"
[channels]
bogie_speed_1_m_s = { column = "/axle:data", name = "axle" }
reference_speed_m_s = { column = "/gnss:twist.linear.x", name = "gnss" }
[[run]]
file = "RUN"
"""
N = 300
TIME_S = 1000.0 + 0.1 * np.arange(N)
SPEED_M_S = 20.0 - 0.05 * np.arange(N)


def write(
    folder: Path,
    mode: Any = MODES.NONE,
    plugin: Any = PLUGINS.SQLITE3,
    zeros: int = 0,
    has_stamps: bool = True,
) -> None:
    """Write a recording `run`, with a last message of `zeros` bytes that are 0.

    Without stamps all headers have the stamp 0.
    """
    store = typesys.get_typestore(typesys.Stores.LATEST)
    Float64 = store.types["std_msgs/msg/Float64"]
    Header = store.types["std_msgs/msg/Header"]
    Time = store.types["builtin_interfaces/msg/Time"]
    Twist = store.types["geometry_msgs/msg/Twist"]
    TwistStamped = store.types["geometry_msgs/msg/TwistStamped"]
    Vector3 = store.types["geometry_msgs/msg/Vector3"]

    bag = rosbag2.Writer(folder / "run", version=9, storage_plugin=plugin)
    if mode != MODES.NONE:
        bag.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with bag:
        axle = bag.add_connection("/axle", Float64.__msgtype__, typestore=store)
        gnss = bag.add_connection("/gnss", TwistStamped.__msgtype__, typestore=store)
        for at_s, speed in zip(TIME_S, SPEED_M_S, strict=True):
            at_ns = round(at_s * 1e9)
            plain = Float64(speed)
            bag.write(axle, at_ns, store.serialize_cdr(plain, Float64.__msgtype__))

            # the stamp of the header differs from the time at which the bag received the message
            header = Header(Time(int(at_s) + 1 if has_stamps else 0, 0), "")
            twist = Twist(Vector3(speed, 0.0, 0.0), Vector3(0.0, 0.0, 0.0))
            stamped = TwistStamped(header, twist)
            bag.write(gnss, at_ns, store.serialize_cdr(stamped, TwistStamped.__msgtype__))
        if zeros:
            bag.write(axle, round(TIME_S[-1] * 1e9), bytes(zeros))
