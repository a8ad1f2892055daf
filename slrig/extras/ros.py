"""A scan as a ROS 2 bag: one MCAP file, as rosbag2 stores it, written by rosbags.

The MCAP holds the bag's metadata as a record, so `ros2 bag play FILE`, Foxglove and rosbags open it without the folder
and metadata.yaml that rosbag2 writes around it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from slrig.disk import storage_errors
from slrig.errors import ExtraMissingError
from slrig.plugins import FileFormat
from slrig.ros_messages import PROJECTOR, TF_STATIC, Device, Messages, topic

if TYPE_CHECKING:
    from slrig.model import Calibration, Pinhole, Pixels
    from slrig.scan.clouds import OrganisedCloud

FORMAT = FileFormat(
    "scan.mcap", "application/octet-stream", "rosbags", "pip install 'slrig[ros]'", "slrig.extras.ros:encode_bag"
)

_FOREVER_S, _FOREVER_NS = 9_223_372_036, 854_775_807  # RMW_DURATION_INFINITE


def encode_bag(
    calibration: Calibration,
    clouds: Iterable[OrganisedCloud],
    whites: Mapping[str, Pixels],
    captured_at: datetime | None,
) -> bytes:
    """Encode transforms and camera_info of all devices, a white image of each camera, and the points of each cloud.

    whites : by camera, (H, W) grey or (H, W, 3) blue, green and red. captured_at : the stamp of all messages; None: 0.
    Every topic has one message and is latched, so that late subscribers receive it.

    Raises
    ------
    ExtraMissingError
        rosbags is not installed.
    StorageError
        The folder for temporary files cannot be written; the library writes files only.
    """
    try:
        from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as cause:
        message = f"{FORMAT.name} is written by rosbags, which is missing: {FORMAT.install}"
        raise ExtraMissingError(message) from cause
    # The oldest that is maintained: later releases have the same definitions of these types.
    types = get_typestore(Stores.ROS2_HUMBLE)
    seconds = 0.0 if captured_at is None else captured_at.timestamp()
    messages = Messages(class_of=types.types.__getitem__, sequence=np.ascontiguousarray, seconds=seconds)
    ever = QosTime(_FOREVER_S, _FOREVER_NS)
    latched = Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=ever,
        lifespan=ever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=ever,
        avoid_ros_namespace_conventions=False,
    )
    with TemporaryDirectory(prefix="slrig-") as parent:
        # Writes FOLDER/FOLDER.mcap.
        folder = Path(parent, Path(FORMAT.name).stem)
        with storage_errors(folder):
            # From version 9 on QoS is stated as text, which Humble does not read; later releases read both.
            writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
            # As chunks of the MCAP, which any reader of the format unpacks.
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            with writer:
                # Names that differ in what ROS's do not have share a topic; frames distinguish them.
                topics: dict[str, Any] = {}

                def write(where: str, message: Any) -> None:
                    kind: str = message.__msgtype__
                    if where not in topics:
                        topics[where] = writer.add_connection(
                            where, kind, typestore=types, offered_qos_profiles=[latched]
                        )
                    writer.write(topics[where], messages.stamp_ns, types.serialize_cdr(message, kind))

                _write(write, messages, calibration, clouds, whites)
            return (folder / FORMAT.name).read_bytes()


def _write(
    write: Callable[[str, Any], None],
    messages: Messages,
    calibration: Calibration,
    clouds: Iterable[OrganisedCloud],
    whites: Mapping[str, Pixels],
) -> None:
    devices = {name: device_of(pinhole) for name, pinhole in calibration.cameras.items()}
    if calibration.projector is not None:
        devices[PROJECTOR] = device_of(calibration.projector)
    write(TF_STATIC, messages.transforms(devices))
    for name, device in devices.items():
        write(topic(name, "camera_info"), messages.camera_info(name, device))
    for name, pixels in whites.items():
        write(topic(name, "image_raw"), messages.image(name, pixels))
    for cloud in clouds:
        write(topic(cloud.camera, "points"), messages.points(cloud))


def device_of(pinhole: Pinhole) -> Device:
    """Convert a device to the form of `slrig.ros_messages`."""
    size = pinhole.size
    return Device(
        size.width_px, size.height_px, pinhole.matrix, pinhole.distortion, pinhole.rotation, pinhole.translation_mm
    )
