"""ROS messages of a depth camera, made by rosbags, and bags of them."""

import struct
from dataclasses import replace
from io import BytesIO

import numpy as np
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

STORE = get_typestore(Stores.ROS2_JAZZY)
K = np.array([[260.0, 0, 79.5], [0, 265.0, 59.5], [0, 0, 1]])
"""First pixel's centre at 0, as in ROS."""
SHAPE = 120, 160
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TF = "tf2_msgs/msg/TFMessage"
DEPTH = "/camera/depth/image_rect_raw"
CAMERA_INFO = "/camera/depth/camera_info"


def message(kind, **fields):
    return STORE.types[kind](**fields)


def header(frame, time=12.5):
    stamp = message(
        "builtin_interfaces/msg/Time", sec=int(time), nanosec=round(1e9 * (time % 1))
    )
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def image_message(depth, encoding, big=False, padding=0, **more):
    """A depth image; with rows that are longer than needed, and of either byte order."""
    kind = np.dtype({"16UC1": "u2", "32FC1": "f4"}[encoding]).newbyteorder(
        ">" if big else "<"
    )
    rows = np.ascontiguousarray(depth, kind).view(np.uint8)
    rows = np.pad(
        rows.reshape(len(depth), -1), ((0, 0), (0, padding)), constant_values=7
    )
    fields = {
        "height": depth.shape[0],
        "width": depth.shape[1],
        "encoding": encoding,
        "is_bigendian": int(big),
    }
    fields |= {"header": header("optical"), "step": rows.shape[1], "data": rows.ravel()}
    return message("sensor_msgs/msg/Image", **(fields | more))


def roi(offset):
    return message(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=offset,
        y_offset=0,
        height=0,
        width=0,
        do_rectify=False,
    )


def info_message(k=K, shape=SHAPE, d=(), p=None, **more):
    p = np.hstack([k, np.zeros((3, 1))]) if p is None else p
    fields = {
        "header": header("optical"),
        "height": shape[0],
        "width": shape[1],
        "distortion_model": "plumb_bob",
    }
    fields |= {
        "d": np.array(d, float),
        "k": np.array(k, float).ravel(),
        "r": np.eye(3).ravel(),
        "p": p.ravel(),
    }
    return message(
        "sensor_msgs/msg/CameraInfo",
        **(fields | {"binning_x": 0, "binning_y": 0, "roi": roi(0)} | more),
    )


def transform_message(pose, child="optical", time=12.5, parent="world"):
    x, y, z, w = map(float, Rotation.from_matrix(pose[:3, :3]).as_quat())
    translation = message(
        "geometry_msgs/msg/Vector3",
        **dict(zip("xyz", map(float, pose[:3, 3]), strict=True)),
    )
    rotation = message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
    transform = message(
        "geometry_msgs/msg/Transform", translation=translation, rotation=rotation
    )
    fields = {
        "header": header(parent, time),
        "child_frame_id": child,
        "transform": transform,
    }
    return message("geometry_msgs/msg/TransformStamped", **fields)


def compressed_message(depth, encoding, time=12.5, scale=40.0, offset=-1.0):
    """A depth image as compressed_depth_image_transport writes it; floats as inverse depth."""
    steps = np.asarray(depth)
    if encoding == "32FC1":
        inverse = scale / np.where(steps > 0, steps, 1) + offset
        steps = np.where(np.asarray(depth) > 0, np.rint(inverse), 0)
    png = BytesIO()
    Image.fromarray(steps.astype(np.uint16)).save(png, "PNG")
    data = struct.pack("<iff", 0, scale, offset) + png.getvalue()
    return message(
        COMPRESSED,
        header=header("optical", time),
        format=f"{encoding}; compressedDepth png",
        data=np.frombuffer(data, np.uint8),
    )


def tf_message(*transforms):
    return message(TF, transforms=list(transforms))


def write_bag(path, messages, mcap=True, empty=(), compressed=None):
    """Write messages, each a topic, seconds at which it was recorded, and the message itself.

    ``empty`` are the types of topics without any, by name; ``compressed`` is "file" or "message".
    """
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compressed is not None:
        mode = CompressionMode[compressed.upper()]
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer as bag:
        connections = {}
        for topic, kind in dict(empty).items():
            bag.add_connection(topic, kind, typestore=STORE)
        for topic, time, given in messages:
            kind = given.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(given, kind)
            bag.write(connections[topic], round(1e9 * time), data)
    return path


def at(given, time):
    """The same message, stamped with another time."""
    return replace(given, header=header(given.header.frame_id, time))
