"""Messages of cameras, in the classes of rosbags for ROS 2 Jazzy, and bags of them."""

from djet_ros.recordings.bag_writers import STORAGES
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)

IMAGE, INFO = '/camera/image_raw', '/camera/camera_info'
IMAGE_TYPE, INFO_TYPE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo'
COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'

SEEN = {
    # by case: the topic and type that are published, and the expected log line
    'elsewhere': ('/front/image_raw', IMAGE_TYPE,
                  f'waiting for image on {IMAGE}: it has no publisher; did you mean '
                  '/front/image_raw?'),
    'compressed': (f'{IMAGE}/compressed', COMPRESSED_TYPE,
                   f'it has no publisher, but {IMAGE}/compressed has; set '
                   'ros.image_transport:=compressed'),
    'another type': (IMAGE, COMPRESSED_TYPE,
                     f'its type is {COMPRESSED_TYPE}, not {IMAGE_TYPE}; set '
                     'ros.image_transport:=compressed'),
    'its camera_info': ('/elsewhere/camera_info', INFO_TYPE,
                        f'waiting for camera_info on {INFO}: it has no publisher; did you mean '
                        '/elsewhere/camera_info?'),
}


def message_type(name):
    return STORE.types[name]


def header(stamp_ns=0, frame_id='camera'):
    seconds, rest = divmod(stamp_ns, 10**9)
    stamp = message_type('builtin_interfaces/msg/Time')(sec=seconds, nanosec=rest)
    return message_type('std_msgs/msg/Header')(stamp=stamp, frame_id=frame_id)


def image(pixels, encoding='mono8', stamp_ns=0, padding=0, frame_id='camera', **changes):
    """Make an Image of an array (H, W) or (H, W, C), with padding bytes after each row."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    fields = {'header': header(stamp_ns, frame_id), 'height': height, 'width': width,
              'encoding': encoding, 'is_bigendian': 0, 'step': rows.shape[1],
              'data': rows.ravel()}
    return message_type('sensor_msgs/msg/Image')(**{**fields, **changes})


def compressed(data, kind='jpeg', stamp_ns=0):
    return message_type('sensor_msgs/msg/CompressedImage')(
        header=header(stamp_ns), format=kind, data=np.frombuffer(data, np.uint8))


def camera_info(K, size, stamp_ns=0, **changes):
    """Make the CameraInfo of an undistorted camera; changes are further fields."""
    roi = message_type('sensor_msgs/msg/RegionOfInterest')(
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    fields = {'header': header(stamp_ns), 'height': size[1], 'width': size[0],
              'distortion_model': 'plumb_bob', 'd': np.zeros(5), 'k': np.asarray(K).ravel(),
              'r': np.eye(3).ravel(), 'p': np.hstack([K, np.zeros((3, 1))]).ravel(),
              'binning_x': 0, 'binning_y': 0, 'roi': roi}
    return message_type('sensor_msgs/msg/CameraInfo')(**{**fields, **changes})


def roi(x, y, width, height):
    return message_type('sensor_msgs/msg/RegionOfInterest')(
        x_offset=x, y_offset=y, height=height, width=width, do_rectify=False)


def record(path, messages, storage='mcap', mode=CompressionMode.NONE, store=STORE):
    """Write (topic, message, stamp) with rosbags; mode FILE, MESSAGE or STORAGE compresses."""
    writer = Writer(path, version=9, storage_plugin=STORAGES[storage])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    connections = {}
    with writer:
        for topic, message, stamp in messages:
            kind = message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic, kind], stamp, store.serialize_cdr(message, kind))
    return path


def serialised(message):
    """Bytes on the wire: rosbags refuses to write what is not of the fields' types."""
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))
