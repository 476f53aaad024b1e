"""Bags are read back as written, and damaged ones as far as possible."""

from collections import Counter
import os
from pathlib import Path
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import tracemalloc

from commands import full_disk
import cv2
from djet_ros.cli.main import main
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import pose_of
from djet_ros.recordings.bag_writers import ResultBag, STORAGES, write_kitti_bag
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.decoding import decoder, jazzy, MAKE, message_type, MOST_OBJECTS
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.recording import BagRecording
from djet_ros.recordings.storages import chunked, open_storage
from djet_ros.recordings.storages.base import BrokenFile, Connection, LARGEST_PIECE
from djet_ros.recordings.storages.compression import zstd
import numpy as np
import pytest
from ros_messages import record
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
SECOND = 10**9
NOETIC = get_typestore(Stores.ROS1_NOETIC)


def image(stamp, size=(64, 48)):
    # Noise: it does not compress, so that every cut and flip hits data.
    pixels = np.random.default_rng(stamp).integers(0, 256, size[::-1], dtype=np.uint8)
    return MAKE.picture(stamp, 'camera', pixels)


def compressed(stamp):
    _, data = cv2.imencode('.png', np.full((48, 64), 9, np.uint8))
    return message_type('sensor_msgs/msg/CompressedImage')(
        header=MAKE.header(stamp, 'camera'), format='png', data=data.ravel())


def info(stamp):
    return MAKE.camera_info(stamp, 'camera', K, (64, 48))


def pose(stamp):
    return MAKE.pose_in(stamp, 'camera', np.eye(4))


def camera_messages(count=30):
    for stamp in range(SECOND, SECOND * (count + 1), SECOND):
        yield '/cam/camera_info', info(stamp), stamp
        yield '/cam/image_raw', image(stamp), stamp


def of_ros1(message, **changed):
    """Return a message in the class of ROS 1: upper-case K, header.seq; changed: other fields."""
    kind, header = message.__msgtype__, message.header
    fields = {name: getattr(message, name.lower() if len(name) == 1 else name)
              for name, _ in NOETIC.fielddefs[kind][1]}
    stamp = NOETIC.types['builtin_interfaces/msg/Time'](header.stamp.sec, header.stamp.nanosec)
    fields['header'] = NOETIC.types['std_msgs/msg/Header'](
        seq=7, stamp=stamp, frame_id=header.frame_id)
    return NOETIC.types[kind](**{**fields, **changed})


def ros1_bag(path, count=30, compression=None):
    """Write the camera of a ROS 1 robot."""
    writer = Ros1Writer(path)
    writer.chunk_threshold = 20_000
    if compression:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for topic, message, stamp in camera_messages(count):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=NOETIC)
            writer.write(connections[topic], stamp,
                         NOETIC.serialize_ros1(of_ros1(message), kind))
    return path


def read_until_broken(path):
    """Messages that a bag delivers, and what it says then (None if it is whole)."""
    delivered = []
    try:
        with Bag(path) as bag:
            for message in bag.messages():
                delivered.append(message)
    except DjetError as error:
        assert '\n' not in str(error)
        assert len(str(error)) < 1000
        return delivered, str(error)
    return delivered, None


def keys(messages):
    return [(m.topic, m.stamp_ns, bytes(getattr(m.message, 'data', b''))) for m in messages]


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """One recording of 30 images in every storage, as single files."""
    folder = tmp_path_factory.mktemp('whole')
    files = {'bag': ros1_bag(folder / 'whole.bag')}
    for storage, suffix in (('mcap', 'mcap'), ('sqlite3', 'db3')):
        record(folder / storage, camera_messages(), storage)
        files[suffix] = folder / storage / f'{storage}.{suffix}'
    # Chunks of a few messages, as a real recording has many.
    chunked = folder / 'chunked'
    with ResultBag(chunked) as bag:
        for topic, message, stamp in camera_messages():
            bag.write(topic, message, stamp)
    files['mcap'] = chunked / 'chunked.mcap'
    return files


# What is written


@pytest.mark.parametrize('storage', STORAGES)
def test_a_converted_sequence_reads_back(small_kitti, tmp_path, storage):
    sequence = KittiSequence(small_kitti(frames=5))
    write_kitti_bag(sequence, tmp_path / 'out', storage)
    with BagRecording(tmp_path / 'out') as source:
        assert len(source) == 5
        assert source.image_topic == '/camera/image_rect'
        assert source.info_topic == '/camera/camera_info'
        assert source.ground_truth_topic == '/ground_truth/pose'
        messages = list(source.messages())
    frames = [messages[i:i + 3] for i in range(0, 15, 3)]
    for i, (truth, camera, picture) in enumerate(frames):
        stamp = sequence.stamps_ns[i]
        for item in (truth, camera, picture):
            assert item.stamp_ns == stamp
            time = item.message.header.stamp
            assert time.sec * SECOND + time.nanosec == stamp
        picture = picture.message
        assert (picture.encoding, picture.step) == ('mono8', 64)
        assert (picture.data.reshape(48, 64) == sequence.raw(i)).all()
        assert camera.message.k.tolist() == sequence.K.ravel().tolist()
        assert (camera.message.width, camera.message.height) == (64, 48)
        assert truth.message.pose.position.z == sequence.poses[i][2, 3]


def test_real_frames_survive_the_conversion(kitti, tmp_path):
    sequence = KittiSequence(kitti / 'sequences' / '06', start=3, end=9)
    write_kitti_bag(sequence, tmp_path / 'bag')
    with BagRecording(tmp_path / 'bag') as source:
        images = [m for m in source.messages() if m.topic == source.image_topic]
    assert [m.stamp_ns for m in images] == sequence.stamps_ns.tolist()
    for i, item in enumerate(images):
        assert (item.message.data.reshape(370, 1226) == sequence.image(i)).all()


@pytest.mark.parametrize('storage', STORAGES)
def test_other_readers_understand_the_bag(small_kitti, tmp_path, storage):
    write_kitti_bag(KittiSequence(small_kitti(frames=4)), tmp_path / 'out', storage)
    with AnyReader([tmp_path / 'out']) as reader:
        assert reader.message_count == 13
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts == {'/tf_static': 1, '/camera/image_rect': 4, '/camera/camera_info': 4,
                          '/ground_truth/pose': 4}
        static = next(c for c in reader.connections if c.topic == '/tf_static')
        assert static.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
        _, _, data = next(reader.messages([static]))
        transform = reader.deserialize(data, static.msgtype).transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'camera_first')


def test_the_map_has_x_ahead_and_z_up(small_kitti, tmp_path):
    write_kitti_bag(KittiSequence(small_kitti(frames=2)), tmp_path / 'out')
    with Bag(tmp_path / 'out') as bag:
        (_, _, static), = bag.messages({'/tf_static'})
    right, down, ahead = pose_of(static.transforms[0])[1][:3, :3].T
    assert np.allclose([ahead, right, down], [[1, 0, 0], [0, -1, 0], [0, 0, -1]])


@pytest.mark.parametrize('storage', STORAGES)
def test_the_same_sequence_gives_the_same_bytes(small_kitti, tmp_path, storage):
    sequence = KittiSequence(small_kitti())
    for parent in ('a', 'b'):
        write_kitti_bag(sequence, tmp_path / parent / 'bag', storage)
    files = [{path.name: path.read_bytes() for path in (tmp_path / parent / 'bag').iterdir()}
             for parent in ('a', 'b')]
    assert len(files[0]) == 2
    assert files[0] == files[1]


def test_an_existing_bag_is_replaced_only_on_demand(small_kitti, tmp_path):
    sequence = KittiSequence(small_kitti(frames=3))
    write_kitti_bag(sequence, tmp_path / 'out')
    with pytest.raises(DjetError, match='out exists already; .* --overwrite'):
        write_kitti_bag(sequence, tmp_path / 'out')
    write_kitti_bag(KittiSequence(sequence.folder, end=2), tmp_path / 'out', overwrite=True)
    with BagRecording(tmp_path / 'out') as source:
        assert len(source) == 2


# What a folder with a bag becomes that holds more, less or something else.
FOREIGN = {
    'notes beside': lambda bag: (bag / 'notes.txt').write_text('mine'),
    'recording beside': lambda bag: shutil.copy(bag / 'out.mcap', bag / 'out_0.mcap'),
    'folder beside': lambda bag: (bag / 'photos').mkdir(),
    'another name': lambda bag: (bag / 'out.mcap').rename(bag / 'rosbag2_0.mcap'),
    'link': lambda bag: (bag / 'out.mcap').symlink_to((bag / 'out.mcap').rename(
        bag.parent / 'kept.mcap')),
    'no metadata': lambda bag: (bag / 'metadata.yaml').unlink(),
    'notes alone': lambda bag: [path.rename(bag / f'{path.name}.txt')
                                for path in [*bag.iterdir()]],
}


@pytest.mark.parametrize('what', FOREIGN)
def test_a_folder_that_is_no_bag_is_never_overwritten(small_kitti, tmp_path, what):
    sequence = KittiSequence(small_kitti(frames=2))
    write_kitti_bag(sequence, tmp_path / 'out')
    FOREIGN[what](tmp_path / 'out')
    before = sorted((tmp_path / 'out').iterdir())
    with pytest.raises(DjetError, match='out exists and is no bag folder as this command writes'):
        write_kitti_bag(sequence, tmp_path / 'out', overwrite=True)
    assert sorted((tmp_path / 'out').iterdir()) == before
    assert [path.name for path in tmp_path.iterdir() if 'out' in path.name] == ['out']


def interrupt():
    raise KeyboardInterrupt


def test_a_conversion_that_fails_leaves_nothing_or_the_old_bag(small_kitti, tmp_path):
    folder = small_kitti(frames=6)
    out = tmp_path / 'place' / 'out'
    write_kitti_bag(KittiSequence(folder, end=2), out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(KeyboardInterrupt):
        write_kitti_bag(KittiSequence(folder), out, progress=interrupt, overwrite=True)
    damaged = folder / 'image_0' / '000004.png'
    damaged.write_bytes(damaged.read_bytes()[:500])
    with pytest.raises(DjetError, match='000004.png is a damaged image'):
        write_kitti_bag(KittiSequence(folder), out, overwrite=True)
    with pytest.raises(DjetError, match='damaged image'):
        write_kitti_bag(KittiSequence(folder), out.parent / 'other')
    assert [path.name for path in out.parent.iterdir()] == ['out']
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize('storage', STORAGES)
def test_a_full_disk_is_reported_and_leaves_no_bag(small_kitti, tmp_path, storage):
    sequence = KittiSequence(small_kitti(frames=80))
    with full_disk(200_000), pytest.raises(
            DjetError, match='out could not be written: .*; nothing was left behind'):
        write_kitti_bag(sequence, tmp_path / 'place' / 'out', storage)
    assert list((tmp_path / 'place').iterdir()) == []


def test_results_are_complete_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError):
        with ResultBag(tmp_path / 'bag') as bag:
            bag.write('odometry', pose(1), 1)
            bag.write('/diagnostics', pose(1), 1)
            raise ZeroDivisionError
    with AnyReader([tmp_path / 'bag']) as reader:
        assert reader.message_count == 2
    with pytest.raises(DjetError, match='exists; choose another name'):
        ResultBag(tmp_path / 'bag')


def test_results_of_a_killed_process_are_readable(tmp_path):
    script = ('import sys, pathlib, numpy\n'
              'from test_bags import *\n'
              'bag = ResultBag(pathlib.Path(sys.argv[1]))\n'
              'for stamp in range(1, 10**6):\n'
              '    bag.write("pose", pose(stamp), stamp)\n'
              '    bag.write("path", pose(stamp), stamp)\n'
              '    print(stamp, flush=True)\n')
    process = subprocess.Popen([sys.executable, '-c', script, str(tmp_path / 'bag')],
                               stdout=subprocess.PIPE, text=True,
                               cwd=Path(__file__).parent,
                               env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    for _ in range(300):
        process.stdout.readline()
    os.kill(process.pid, signal.SIGKILL)
    rest, _ = process.communicate()
    printed = int(rest.split('\n')[-2]) if '\n' in rest else 300
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    delivered, problem = read_until_broken(tmp_path / 'bag')
    assert 'everything before that was read' in problem
    assert len(delivered) >= 2 * (printed - 1)
    assert [m.stamp_ns for m in delivered] == [i // 2 + 1 for i in range(len(delivered))]


def test_a_bag_that_does_not_fit_is_closed_and_readable(tmp_path):
    bag, written = ResultBag(tmp_path / 'bag'), 0
    with full_disk(20_000):
        with pytest.raises(DjetError, match='the messages written so far are readable'):
            for written in range(1, 1000):
                bag.write('pose', pose(written), written)
        with pytest.raises(DjetError, match='could not be written'):
            bag.close()
    opened = [os.path.realpath(path) for path in Path('/proc/self/fd').iterdir()]
    assert not any(path.startswith(str(tmp_path)) for path in opened)
    delivered, _ = read_until_broken(tmp_path / 'bag')
    assert 10 < written - 10 < len(delivered) < written
    assert [m.stamp_ns for m in delivered] == list(range(1, len(delivered) + 1))


def test_the_command_converts(small_kitti, tmp_path, capsys):
    arguments = ['kitti-to-bag', str(small_kitti(frames=6)), str(tmp_path / 'out'), '--storage',
                 'sqlite3', '--start', '1', '--end', '4']
    assert main(arguments) == 0
    assert capsys.readouterr().out == (
        f'{tmp_path / "out"}: 3 frames of 64x48, 0.2 s, with ground truth\n')
    assert (tmp_path / 'out' / 'out.db3').exists()
    assert main(arguments) == 2
    assert 'pass --overwrite' in capsys.readouterr().err


# What is read


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE,
                                  CompressionMode.STORAGE])
def test_compressed_bags_are_read(tmp_path, storage, mode):
    if (storage, mode) == ('sqlite3', CompressionMode.STORAGE):
        pytest.skip('sqlite3 has no compression of its own')
    path = record(tmp_path / 'bag', camera_messages(5), storage, mode)
    delivered, problem = read_until_broken(path)
    assert problem is None
    expected, _ = read_until_broken(record(tmp_path / 'plain', camera_messages(5)))
    assert keys(delivered) == keys(expected)


@pytest.mark.parametrize('compression', [None, *Ros1Writer.CompressionFormat])
def test_ros1_bags_give_the_messages_of_jazzy(tmp_path, compression):
    with BagRecording(ros1_bag(tmp_path / 'old.bag', 5, compression)) as source:
        assert len(source) == 5
        messages = list(source.messages())
    for camera, picture in zip(messages[::2], messages[1::2], strict=True):
        stamp = camera.stamp_ns
        assert type(camera.message) is message_type('sensor_msgs/msg/CameraInfo')
        assert camera.message.k.tolist() == K.ravel().tolist()
        assert camera.message.header == MAKE.header(stamp, 'camera')
        assert (picture.message.data == image(stamp).data).all()


@pytest.mark.parametrize('suffix', ['mcap', 'db3', 'bag'])
def test_a_single_file_is_a_bag_whatever_its_name(whole, tmp_path, suffix):
    path = shutil.copy(whole[suffix], tmp_path / 'run #1?.data')
    delivered, problem = read_until_broken(path)
    assert problem is None
    assert len(delivered) == 60
    assert Counter(m.topic for m in delivered) == {'/cam/camera_info': 30, '/cam/image_raw': 30}


def test_split_bags_are_read_in_order_with_and_without_metadata(tmp_path):
    bag = tmp_path / 'bag'
    bag.mkdir()
    for part in range(11):
        stamps = range(part * 3 + 1, part * 3 + 4)
        record(tmp_path / 'x', ((f'/part{part % 2}', pose(s), s) for s in stamps))
        shutil.move(tmp_path / 'x' / 'x.mcap', bag / f'bag_{part}.mcap')
        shutil.rmtree(tmp_path / 'x')
    for metadata in (None, [], [f'bag_{part}.mcap' for part in range(11)],
                     [f'bag/bag_{part}.mcap' for part in range(11)]):
        if metadata is not None:  # an empty file is what a full disk leaves
            (bag / 'metadata.yaml').write_text(
                f'rosbag2_bagfile_information: {{relative_file_paths: {metadata}}}'
                if metadata else '')
        delivered, problem = read_until_broken(bag)
        assert problem is None
        assert [m.stamp_ns for m in delivered] == list(range(1, 34))


@pytest.mark.parametrize('storage', STORAGES)
def test_messages_come_in_the_order_of_time_not_of_writing(tmp_path, storage):
    stamps = np.random.default_rng(3).permutation(np.arange(1, 900)).tolist()
    path = record(tmp_path / 'bag', (('/image', image(s), s) for s in stamps), storage)
    with Bag(path) as bag:
        assert [m.stamp_ns for m in bag.messages()] == sorted(stamps)


def test_an_mcap_without_chunks_or_index_is_read(whole, tmp_path):
    loose = tmp_path / 'loose.mcap'
    loose.write_bytes(without_chunks(whole['mcap'].read_bytes()))
    delivered, problem = read_until_broken(loose)
    assert problem is None
    assert keys(delivered) == keys(read_until_broken(whole['mcap'])[0])


def without_chunks(data):
    """Dissolve the chunks of an MCAP file, and leave out its summary."""
    output, position = [data[:8]], 8
    while True:
        code, length = struct.unpack_from('<BQ', data, position)
        end = position + 9 + length
        if code == 6:
            # After the times, sizes and checksum comes an empty compression name.
            output.append(data[position + 9 + 40:end])
        elif code == 15:
            footer = struct.pack('<BQQQI', 2, 20, 0, 0, 0)
            return b''.join([*output, data[position:end], footer, data[:8]])
        elif code not in (7,):
            output.append(data[position:end])
        position = end


@pytest.mark.parametrize('storage', STORAGES)
def test_a_bag_is_never_whole_in_memory(tmp_path, storage):
    path = record(tmp_path / 'bag', (('/image', image(s, (1000, 800)), s) for s in range(1, 61)),
                  storage)
    with Bag(path) as bag:
        tracemalloc.start()
        count = sum(1 for _ in bag.messages())
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert count == 60
    assert peak < 20e6, 'of 48 MB'


def test_bags_older_than_iron_have_no_definitions(whole, tmp_path):
    path = shutil.copy(whole['db3'], tmp_path / 'humble.db3')
    with sqlite3.connect(path) as database:
        database.execute('DROP TABLE message_definitions')
        database.execute('DROP TABLE schema')
    delivered, problem = read_until_broken(path)
    assert problem is None
    assert keys(delivered) == keys(read_until_broken(whole['db3'])[0])


def changed_types(change):
    """Types of Jazzy with the definition of Image changed."""
    store = get_typestore(Stores.EMPTY)
    text, _ = jazzy().generate_msgdef('sensor_msgs/msg/Image', ros_version=2)
    store.register(get_types_from_msg(change(text), 'sensor_msgs/msg/Image'))
    return store


def changed_image(store, **fields):
    plain = image(5)
    names = [name for name, _ in store.fielddefs['sensor_msgs/msg/Image'][1]]
    return store.types['sensor_msgs/msg/Image'](
        **{name: fields[name] if name in fields else getattr(plain, name) for name in names})


@pytest.mark.parametrize('storage', STORAGES)
def test_a_type_that_differs_is_read_by_the_recorded_definition(tmp_path, storage):
    store = changed_types(lambda text: text.replace('uint32 height', 'float64 gain\nint64 height'))
    path = record(tmp_path / 'bag', [('/image', changed_image(store, gain=2.0), 5)], storage,
                  store=store)
    with Bag(path) as bag:
        item, = bag.messages()
    assert type(item.message) is message_type('sensor_msgs/msg/Image')
    assert item.message.height == 48
    assert (item.message.data == image(5).data).all()


@pytest.mark.parametrize(('old', 'new', 'value'), [
    ('uint32 height', 'string height', 'high'), ('uint32 height', 'uint32 tallness', 48)])
def test_a_type_that_lacks_what_jazzy_has_is_refused(tmp_path, old, new, value):
    store = changed_types(lambda text: text.replace(old, new))
    message = changed_image(store, **{new.split()[1]: value})
    delivered, problem = read_until_broken(
        record(tmp_path / 'bag', [('/image', message, 5)], store=store))
    assert delivered == []
    assert "recorded without a field 'height'" in problem


# Which topics are the camera


def source_error(path, **topics):
    with pytest.raises(DjetError) as caught:
        BagRecording(path, **topics)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def test_two_cameras_are_listed_with_their_counts(tmp_path):
    messages = [(f'/{side}/{name}', make(stamp), stamp) for side in ('left', 'right')
                for name, make in (('camera_info', info), ('image_raw', image))
                for stamp in range(1, 4)]
    path = record(tmp_path / 'bag', [*messages, ('/left/image_raw', image(9), 9)])
    problem = source_error(path)
    assert '/left/image_raw (4), /right/image_raw (3); choose one with --image-topic' in problem
    with BagRecording(path, image_topic='/right/image_raw') as source:
        assert (source.info_topic, len(source)) == ('/right/camera_info', 3)
        assert {m.topic for m in source.messages()} == {'/right/camera_info', '/right/image_raw'}
    assert "no image topic '/top/image'; choose from /left" in source_error(
        path, image_topic='/top/image')
    assert "no CameraInfo topic '/tf'; choose from /left" in source_error(
        path, image_topic='/left/image_raw', info_topic='/tf')


def test_a_compressed_image_has_the_camera_of_its_raw_topic(tmp_path):
    path = record(tmp_path / 'bag', [
        ('/other/camera_info', info(1), 1), ('/cam/camera_info', info(1), 1),
        ('/cam/image_raw/compressed', compressed(1), 1)])
    with BagRecording(path) as source:
        assert source.info_topic == '/cam/camera_info'
        assert source.image_topic == '/cam/image_raw/compressed'


def test_an_only_camera_info_serves_an_only_camera(tmp_path):
    path = record(tmp_path / 'one', [('/calibration', info(1), 1), ('/cam/image', image(1), 1)])
    with BagRecording(path) as source:
        assert source.info_topic == '/calibration'
    path = record(tmp_path / 'two', [('/a/image', image(1), 1), ('/b/image', image(1), 1),
                                     ('/a/camera_info', info(1), 1)])
    problem = source_error(path, image_topic='/b/image')
    assert 'no camera_info in the namespace of /b/image; to use /a/camera_info' in problem


def test_an_auxiliary_topic_is_found_or_named_or_its_lack_has_a_remedy(tmp_path):
    path = record(tmp_path / 'bag', [*camera_messages(2), ('/people', image(2), SECOND)])
    named = BagRecording(path, '/cam/image_raw', auxiliary={'mask': '/people'})
    with named as source:
        assert source.auxiliary == {'mask': '/people'}
    for what, name, problem in (
            ('mask', None, "has no single topic for 'mask'; choose one with --mask-topic from: "
             '/people'),
            ('mask', '/animals', "has no topic '/animals' for 'mask'; choose one with "
             '--mask-topic from: /people'),
            ('speed', None, "has no topic for 'speed' (geometry_msgs/msg/TwistStamped or "
             'nav_msgs/msg/Odometry); record one, or set the parameters so that none is needed'),
            ('tf', None, 'has no topic /tf, which odometry.guess_frame requires')):
        assert problem in source_error(path, image_topic='/cam/image_raw',
                                       auxiliary={what: name})


def test_ground_truth_is_found_by_its_name(tmp_path):
    path = record(tmp_path / 'bag', [*camera_messages(2), ('/groundtruth', pose(1), SECOND),
                                     ('/estimate', pose(1), SECOND)])
    with BagRecording(path) as source:
        assert source.ground_truth_topic == '/groundtruth'
        assert len(list(source.messages())) == 5


def test_of_several_ground_truths_none_is_chosen_nor_taken_for_a_measurement(tmp_path):
    zero = message_type('geometry_msgs/msg/Vector3')(0.0, 0.0, 0.0)
    with_covariance = {
        'pose': message_type('geometry_msgs/msg/PoseWithCovariance')(pose(1).pose, np.zeros(36)),
        'twist': message_type('geometry_msgs/msg/TwistWithCovariance')(
            message_type('geometry_msgs/msg/Twist')(zero, zero), np.zeros(36))}
    truth = message_type('nav_msgs/msg/Odometry')(
        header=MAKE.header(1, 'map'), child_frame_id='', **with_covariance)
    path = record(tmp_path / 'bag', [*camera_messages(2), ('/ground_truth/pose', pose(1), SECOND),
                                     ('/ground_truth/odom', truth, SECOND)])
    with BagRecording(path) as source:
        assert source.ground_truth_topic is None
        assert sorted(source.ground_truth_choices) == ['/ground_truth/odom', '/ground_truth/pose']
    with pytest.raises(DjetError, match="no topic for 'speed'"):
        BagRecording(path, auxiliary={'speed': None})


def test_messages_within_messages_of_ros_1_are_those_of_jazzy(tmp_path):
    path = MAKE.path([MAKE.pose_in(SECOND + i, 'odom', np.eye(4)) for i in range(3)])
    message = of_ros1(path, poses=[of_ros1(one) for one in path.poses])
    with Ros1Writer(tmp_path / 'old.bag') as writer:
        connection = writer.add_connection('/path', message.__msgtype__, typestore=NOETIC)
        writer.write(connection, SECOND, NOETIC.serialize_ros1(message, message.__msgtype__))
    with Bag(tmp_path / 'old.bag') as bag:
        read, = bag.messages()
    assert read.message == path


def test_an_empty_ros1_bag_is_empty_and_not_broken(tmp_path):
    assert 'holds no messages' in source_error(ros1_bag(tmp_path / 'old.bag', count=0))


def test_a_topic_of_two_types_is_refused_by_name(tmp_path):
    path = record(tmp_path / 'bag', [
        *camera_messages(2), ('/other/info', info(1), 1), ('/other/info', pose(1), 2)])
    with BagRecording(path) as source:
        assert len(list(source.messages())) == 4
    problem = source_error(path, info_topic='/other/info')
    assert "several types on '/other/info': geometry_msgs/msg/PoseStamped, sensor_msgs" in problem


def test_names_from_a_bag_can_not_control_the_terminal(tmp_path):
    path = record(tmp_path / 'bag', [('/image\n\x1b[2J1', image(1), 1), ('/image2', image(1), 1)])
    assert 'has 2 image topics: /image ?[2J1 (1), /image2 (1)' in source_error(path)


@pytest.mark.parametrize(('messages', 'problem'), [
    ([], 'holds no messages'),
    ([('/pose', pose(1), 1)], 'has no image topic, only /pose (geometry_msgs/msg/PoseStamped)'),
    ([('/image', image(1), 1)], 'has no CameraInfo topic, only /image (sensor_msgs/msg/Image); '
     'record it too, or put the images into a folder with their calibration.yaml'),
])
@pytest.mark.parametrize('storage', STORAGES)
def test_a_bag_without_a_camera_is_refused(tmp_path, storage, messages, problem):
    assert problem in source_error(record(tmp_path / 'bag', messages, storage))


# What is broken


@pytest.mark.parametrize('suffix', ['mcap', 'db3', 'bag'])
def test_a_bag_cut_short_is_read_up_to_the_cut(whole, tmp_path, suffix):
    data = whole[suffix].read_bytes()
    expected = keys(read_until_broken(whole[suffix])[0])
    path = tmp_path / f'cut.{suffix}'
    counts = []
    for part in (0.01, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8):
        path.write_bytes(data[:int(len(data) * part)])
        delivered, problem = read_until_broken(path)
        assert str(path) in problem
        if suffix == 'db3':
            # The index by stamps may be cut too; then they come as recorded.
            assert set(keys(delivered)) <= set(expected)
        else:
            assert keys(delivered) == expected[:len(delivered)]
        counts.append(len(delivered))
    assert counts == sorted(counts)
    assert counts[3] >= len(expected) / 3


@pytest.mark.parametrize('suffix', ['mcap', 'bag'])
def test_a_bag_that_lost_only_its_index_has_lost_nothing(whole, tmp_path, suffix):
    path = tmp_path / f'cut.{suffix}'
    path.write_bytes(whole[suffix].read_bytes()[:-50])
    delivered, problem = read_until_broken(path)
    assert problem is None
    assert keys(delivered) == keys(read_until_broken(whole[suffix])[0])


@pytest.mark.parametrize('declared', ['none', 'absurd'])
def test_wrong_counts_in_an_mcap_are_those_of_its_messages(whole, tmp_path, declared):
    data = bytearray(whole['mcap'].read_bytes())
    # The statistics: 46 bytes, then (channel, count) of each of the two channels.
    begin = data.rindex(struct.pack('<BQ', 0x0B, 46 + 2 * 10)) + 9 + 42
    if declared == 'none':
        # As the format allows: the counts are not known.
        struct.pack_into('<I', data, begin, 0)
    else:
        struct.pack_into('<Q', data, begin + 4 + 2, 2**63)
    path = tmp_path / 'wrong.mcap'
    path.write_bytes(data)
    with Bag(path) as bag, Bag(whole['mcap']) as right:
        assert bag.topics == right.topics
    assert keys(read_until_broken(path)[0]) == keys(read_until_broken(whole['mcap'])[0])


def test_a_compressed_chunk_cut_short_gives_its_first_messages(tmp_path):
    path = record(tmp_path / 'bag', camera_messages(200), mode=CompressionMode.STORAGE)
    data = (path / 'bag.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(data[:len(data) // 2])
    delivered, problem = read_until_broken(tmp_path / 'cut.mcap')
    assert len(delivered) > 100
    assert 'is cut short' in problem


def test_a_compressed_file_cut_short_gives_its_first_messages(tmp_path):
    path = record(tmp_path / 'bag', camera_messages(60), mode=CompressionMode.FILE)
    file = path / 'bag.mcap.zstd'
    file.write_bytes(file.read_bytes()[:int(file.stat().st_size * 0.8)])
    delivered, problem = read_until_broken(path)
    assert len(delivered) > 30
    assert str(file) in problem
    assert not list(Path(os.environ.get('TMPDIR', '/tmp')).glob('djet-*/bag.mcap*'))


def test_a_bag_compressed_by_file_is_unpacked_one_file_at_a_time(tmp_path, monkeypatch):
    """Each pass reads the whole bag, and so do two at once."""
    (tmp_path / 'scratch').mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'scratch'))
    bag = tmp_path / 'bag'
    bag.mkdir()
    for part in range(3):
        one = record(tmp_path / f'part_{part}', (('/pose', pose(s), s) for s in range(
            10 * part + 1, 10 * part + 11)), mode=CompressionMode.FILE)
        shutil.move(one / f'part_{part}.mcap.zstd', bag / f'bag_{part}.mcap.zstd')
    with Bag(bag) as opened:
        for _ in range(2):
            stamps = []
            for first, second in zip(opened.messages(), opened.messages(), strict=True):
                assert len(list((tmp_path / 'scratch').glob('*/*'))) == 1
                assert first.stamp_ns == second.stamp_ns
                stamps.append(first.stamp_ns)
            assert stamps == list(range(1, 31))
    assert list((tmp_path / 'scratch').iterdir()) == []


@pytest.mark.parametrize('suffix', ['mcap', 'db3', 'bag'])
def test_flipped_bits_end_in_messages_or_one_line(whole, tmp_path, suffix):
    data = whole[suffix].read_bytes()
    rng = np.random.default_rng(5)
    path = tmp_path / f'flipped.{suffix}'
    for _ in range(60):
        flipped = np.frombuffer(data, np.uint8).copy()
        # Half of them in the structures at the ends, where they hurt most.
        where = rng.integers(0, len(data), 20)
        where[:10] = np.minimum(rng.integers(0, 3000, 10), len(data) - 1)
        where[5:10] = len(data) - 1 - where[5:10]
        chosen = where[rng.integers(0, 20, rng.integers(1, 4))]
        flipped[chosen] ^= np.uint8(1) << rng.integers(0, 8, len(chosen)).astype(np.uint8)
        path.write_bytes(flipped.tobytes())
        delivered, problem = read_until_broken(path)
        assert problem or delivered


def test_a_damaged_chunk_is_noticed_by_its_checksum(whole, tmp_path):
    data = bytearray(whole['mcap'].read_bytes())
    # The second chunk gets a checksum that is wrong.
    second = [i for i in range(8, len(data) - 9) if data[i] == 6
              and data[i + 1:i + 9] == data[i + 1:i + 3] + bytes(6)
              and data[i + 37:i + 41] == bytes(4)][1]
    data[second + 33:second + 37] = b'\x01\x02\x03\x04'
    (tmp_path / 'bad.mcap').write_bytes(data)
    delivered, problem = read_until_broken(tmp_path / 'bad.mcap')
    assert 'does not match its checksum' in problem
    assert len(delivered) >= 2


@pytest.mark.parametrize(('content', 'problem'), [
    (b'', 'is empty (0 bytes)'),
    (b'hello, this is no bag', "begins with b'hello, t'; name a bag, or a folder of images"),
    (b'#ROSBAG V1.2\n', 'ROS 1 bag (format 2.0)'),
    (b'#ROSBAG V2.0\n', 'cut short at byte'),
    (b'\x89MCAP0\r\n', 'cut short at byte 8'),
    (b'\x89MCAP0\r\n' + bytes(5000), 'there is no record at byte 8'),
    (b'SQLite format 3\x00', 'not a database'),
    (b'SQLite format 3\x00' + bytes(5000), 'not a database'),
    (b'\x28\xb5\x2f\xfdhello', 'zstd data is damaged'),
])
def test_a_file_that_is_no_bag_is_refused(tmp_path, content, problem):
    (tmp_path / 'file.mcap').write_bytes(content)
    delivered, problems = read_until_broken(tmp_path / 'file.mcap')
    assert delivered == []
    assert problem in problems


def test_a_path_that_is_no_bag_is_refused(tmp_path):
    assert 'nothing does not exist' in source_error(tmp_path / 'nothing')
    assert 'it has neither metadata.yaml nor .mcap or .db3' in source_error(tmp_path)
    os.mkfifo(tmp_path / 'pipe.mcap')
    assert 'is no regular file' in source_error(tmp_path / 'pipe.mcap')


@pytest.mark.parametrize(('statement', 'problem'), [
    ('DROP TABLE messages', "no table 'messages'"),
    ('DROP TABLE topics', "no table 'topics'"),
    ('ALTER TABLE topics DROP COLUMN type', 'no such column: type'),
    ('ALTER TABLE messages DROP COLUMN data', 'no such column: data'),
    ("UPDATE topics SET name = x'00ff'", "table 'topics' holds the row"),
    ("UPDATE topics SET serialization_format = 'json'", "encoding 'json' is neither cdr nor"),
    ("UPDATE topics SET type = 'a/msg/B'; DROP TABLE message_definitions",
     "type 'a/msg/B' can't be used: ValueError it is not in"),
    ("UPDATE messages SET timestamp = 'now' WHERE id = 7", "holds the stamp 'now'"),
    ('UPDATE messages SET timestamp = -1 WHERE id = 7', 'at a time that ROS has no stamp for'),
    (f'UPDATE messages SET timestamp = {2**31 * SECOND} WHERE id = 7',
     'at a time that ROS has no stamp for'),
    ("UPDATE messages SET data = 'text' WHERE id = 7", "with the data 'text'"),
    ("UPDATE messages SET data = x'00' WHERE id = 7", 'at 4000000000 ns: it is no sensor_msgs'),
    ("UPDATE messages SET data = x'28b52ffd00' WHERE id = 7", 'a zstd message is'),
    ("UPDATE message_definitions SET encoded_message_definition = 'x'", "can't be used"),
    ("UPDATE message_definitions SET encoded_message_definition = 'Image[9] again'",
     "can't be used"),
    ("UPDATE message_definitions SET encoded_message_definition = 'string[2000000000] a'",
     'has fixed arrays of 2000000000 elements'),
])
def test_a_wrong_database_is_refused(whole, tmp_path, statement, problem):
    path = shutil.copy(whole['db3'], tmp_path / 'wrong.db3')
    with sqlite3.connect(path) as database:
        database.execute('DROP INDEX timestamp_idx')
        database.executescript(statement)
    _, problems = read_until_broken(path)
    assert problems is not None
    assert problem in problems


@pytest.mark.parametrize(('metadata', 'problem'), [
    ('[../secret.db3]', "'../secret.db3', which lies outside the bag"),
    ('[/etc/passwd]', "'/etc/passwd', which lies outside the bag"),
    ('[bag.mcap, gone.mcap]', "'gone.mcap', which does not exist"),
    ('[]', 'lists no file'),
    ('[bag.mcap, bag.mcap]', "lists 'bag.mcap' 2 times"),
    ('[bag.mcap, bag/bag.mcap]', "lists 'bag.mcap' 2 times"),
    ('7', "no list 'relative_file_paths'"),
    ('[{a: b}]', "no list 'relative_file_paths'"),
    ('[', 'is not valid YAML'),
    pytest.param('[' * 5000, 'is not valid YAML', id='deep'),
    ('!!python/object/apply:os.system [exit]', 'is not valid YAML'),
    pytest.param('bag.mcap' * 400_000, 'more than the limit of 2097152', id='large'),
])
def test_wrong_metadata_is_refused(tmp_path, metadata, problem):
    path = record(tmp_path / 'bag', camera_messages(2))
    (path / 'metadata.yaml').write_text(
        f'rosbag2_bagfile_information: {{relative_file_paths: {metadata}}}')
    assert problem in source_error(path)


@pytest.mark.parametrize(('table', 'columns'), [
    ('messages', 'id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, '
                 'data BLOB GENERATED ALWAYS AS (zeroblob(100000000))'),
    ('topics', 'id INTEGER PRIMARY KEY, type TEXT, serialization_format TEXT, '
               'name TEXT GENERATED ALWAYS AS (hex(zeroblob(60000000)))'),
    ('message_definitions', 'topic_type TEXT, encoding TEXT, encoded_message_definition TEXT '
                            f"DEFAULT '{'x' * 100}'")])
def test_a_database_with_values_that_are_not_in_the_file_is_refused(
        whole, tmp_path, table, columns):
    """Of a few kB, with 30 rows, they would be gigabytes."""
    path = shutil.copy(whole['db3'], tmp_path / 'small.db3')
    with sqlite3.connect(path) as database:
        database.executescript(f'DROP TABLE {table}; CREATE TABLE {table} ({columns})')
    delivered, problem = read_until_broken(path)
    assert delivered == []
    assert problem is not None
    assert f"its table '{table}' is not one of rosbag2's" in problem


def test_a_virtual_table_is_no_table_of_a_bag(whole, tmp_path):
    path = shutil.copy(whole['db3'], tmp_path / 'virtual.db3')
    with sqlite3.connect(path) as database:
        database.executescript('DROP TABLE messages; CREATE VIRTUAL TABLE messages USING '
                               'fts5(topic_id, timestamp, data)')
    assert "its table 'messages' is not one of rosbag2's" in str(read_until_broken(path)[1])


def test_messages_without_an_index_are_sorted_without_their_data(tmp_path):
    """All that SQLite sorts goes into a temporary file, which would be as large as the bag."""
    stamps = [3, 1, 2]
    path = record(tmp_path / 'bag', [('/image', image(stamp), stamp) for stamp in stamps],
                  'sqlite3') / 'bag.db3'
    with sqlite3.connect(path) as database:
        database.execute('DROP INDEX timestamp_idx')
    statements = []
    connect = sqlite3.connect

    def traced(*arguments, **options):
        database = connect(*arguments, **options)
        database.set_trace_callback(statements.append)
        return database

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sqlite3, 'connect', traced)
        delivered, problem = read_until_broken(path)
    assert problem is None
    assert [message.stamp_ns for message in delivered] == sorted(stamps)
    with connect(path) as database:
        plans = {statement: database.execute(f'EXPLAIN QUERY PLAN {statement}').fetchall()
                 for statement in statements if 'FROM messages' in statement}
    assert not [statement for statement, plan in plans.items()
                if 'data' in statement and 'TEMP B-TREE' in str(plan)]


def text(value):
    return struct.pack('<I', len(value)) + value


def mcap_record(code, body):
    return struct.pack('<BQ', code, len(body)) + body


MCAP_HEAD = b'\x89MCAP0\r\n' + mcap_record(1, text(b'ros2') + text(b''))


def chunk(data, declared):
    """Build a zstd chunk of an MCAP file that claims to unpack to some size."""
    return mcap_record(6, struct.pack('<QQQI', 1, 1, declared, 0) + text(b'zstd')
                       + struct.pack('<Q', len(data)) + data)


def test_huge_sizes_are_refused_and_not_allocated(tmp_path):
    packer = zstd.ZstdCompressor()
    bomb = b''.join([*(packer.compress(bytes(1 << 20)) for _ in range(600)), packer.flush()])
    assert len(bomb) < 80_000
    # Little more than the interpreter and its libraries need; unpacking would break it.
    script = ('import resource, sys, pathlib\n'
              'from test_bags import read_until_broken\n'
              'import djet_ros.recordings.decoding\n'
              'used = int(open("/proc/self/statm").read().split()[0]) * 4096\n'
              'resource.setrlimit(resource.RLIMIT_AS, (used + (300 << 20),) * 2)\n'
              'for path in sys.argv[1:]:\n'
              '    print(read_until_broken(pathlib.Path(path))[1])\n')
    message = whole_message(tmp_path, bomb)
    for name, declared in (('honest', 600 << 20), ('liar', 1000), ('absurd', 2**63)):
        (tmp_path / name).write_bytes(MCAP_HEAD + chunk(bomb, declared))
    run = subprocess.run(
        [sys.executable, '-c', script, *(tmp_path / name for name in ('honest', 'liar', 'absurd')),
         message], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent, check=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
    honest, liar, absurd, long = run.stdout.splitlines()
    assert f'at most {LARGEST_PIECE} are decompressed' in honest
    assert 'more than the 1000 bytes declared' in liar
    assert f'declares {2**63} bytes' in absurd
    assert 'a zstd message is truncated or too large' in long


def mcap_of(records, times):
    """Build an MCAP file of one zstd chunk, as often as wanted."""
    schema = struct.pack('<H', 1) + text(b'sensor_msgs/msg/Image') + text(b'ros2msg') + text(b'')
    channel = struct.pack('<HH', 1, 1) + text(b'/image') + text(b'cdr') + text(b'')
    data = mcap_record(3, schema) + mcap_record(4, channel) + records
    return (MCAP_HEAD + chunk(zstd.compress(data), len(data)) * times
            + mcap_record(15, bytes(4)) + mcap_record(2, bytes(20)) + MCAP_HEAD[:8])


def test_chunks_that_unpack_to_more_than_memory_holds_are_refused(tmp_path, monkeypatch):
    """All of them begin at the same time, so that none is done before the last was read."""
    monkeypatch.setattr(chunked, 'MOST_WAITING', 1000)
    monkeypatch.setattr(chunked, 'MOST_HELD', 1 << 20)
    message = struct.pack('<HIQQ', 1, 0, 1, 1)
    for data in (mcap_of(mcap_record(5, message) * 501, 2),
                 mcap_of(mcap_record(5, message + bytes((1 << 20) // 5)), 6)):
        (tmp_path / 'bomb').write_bytes(data)
        with pytest.raises(BrokenFile, match='so far out of order, at byte .* chunks in memory'):
            next(open_storage(tmp_path / 'bomb').messages({1}))


def test_chunks_in_the_order_of_their_topics_are_merged_by_time(tmp_path):
    """As a tool writes them that copies one topic after the other; far more than four overlap."""
    path = tmp_path / 'bag'
    with ResultBag(path) as bag:
        for topic in range(8):
            for stamp in range(1, 40):
                bag.write(f'/image{topic}', image(8 * stamp + topic), 8 * stamp + topic)
    with Bag(path) as opened:
        messages = [(m.stamp_ns, m.topic) for m in opened.messages()]
    assert messages == [(stamp, f'/image{stamp % 8}') for stamp in range(8, 320)]


def whole_message(tmp_path, data):
    """Database with one message of given bytes."""
    path = record(tmp_path / 'message', [('/image', image(1), 1)], 'sqlite3') / 'message.db3'
    with sqlite3.connect(path) as database:
        database.execute('UPDATE messages SET data = ?', (data,))
    return path


def test_an_image_that_declares_more_than_it_has_is_delivered_as_it_is(tmp_path):
    message = image(1)
    message.height = message.width = message.step = 2**31
    with Bag(record(tmp_path / 'bag', [('/image', message, 1)])) as bag:
        item, = bag.messages()
    assert item.message.height == 2**31
    assert len(item.message.data) == 64 * 48


def test_a_sequence_that_declares_more_than_the_message_holds_is_refused(tmp_path):
    data = bytearray(jazzy().serialize_cdr(image(1), 'sensor_msgs/msg/Image'))
    where = data.index(struct.pack('<I', 64 * 48), 20)
    data[where:where + 4] = b'\xff\xff\xff\xff'
    delivered, problem = read_until_broken(whole_message(tmp_path, bytes(data)))
    assert delivered == []
    assert 'it is no sensor_msgs/msg/Image' in problem


def test_storage_plugins_are_those_that_rosbags_has():
    assert set(STORAGES.values()) == set(StoragePlugin)


def outer(count, element, size=0, encoding='ros1'):
    """Try to read a message that declares so many elements of a type of its own."""
    definition = f'Inner[] all\n{"=" * 80}\nMSG: some/Inner\n{element}\n'
    head = b'' if encoding == 'ros1' else b'\0\1\0\0'
    read = decoder(Connection(0, '/all', 'some/msg/Outer', encoding, definition, 1))
    return read(memoryview(head + struct.pack('<I', count) + bytes(size)))


def test_elements_that_take_no_bytes_are_refused():
    # Few enough for this machine, should they be read.
    with pytest.raises(BrokenFile, match='sequences of elements that take no bytes'):
        outer(3_000_000, '')
    with pytest.raises(BrokenFile, match='sequences of elements that take no bytes'):
        outer(3_000_000, f'Nothing[3] nothing\n{"=" * 80}\nMSG: some/Nothing\n')


@pytest.mark.parametrize(('encoding', 'element', 'size'), [
    # Each element becomes two objects: itself, and the field.
    ('ros1', 'uint8 x', MOST_OBJECTS // 2 + 1), ('cdr', 'uint8 x', MOST_OBJECTS // 2 + 1),
    ('ros1', 'string x', 2 * MOST_OBJECTS + 1), ('ros1', 'float64[3] x', 12 * MOST_OBJECTS + 1)])
def test_messages_that_may_unfold_to_more_than_memory_holds_are_refused(encoding, element, size):
    with pytest.raises(BrokenFile, match='could exceed the memory when deserialised'):
        outer(2**20, element, size, encoding)


def test_transforms_that_unfold_to_many_times_their_bytes_are_refused():
    """Of 1.7 million transforms in 129 MB, few enough bytes, the objects would take gigabytes."""
    one, _ = NOETIC.generate_msgdef('geometry_msgs/msg/TransformStamped')
    definition = (f'geometry_msgs/TransformStamped[] transforms\n{"=" * 80}\n'
                  f'MSG: geometry_msgs/TransformStamped\n{one}')
    read = decoder(Connection(0, '/tf', 'tf2_msgs/msg/TFMessage', 'ros1', definition, 1))
    of_one = 76
    for count, refused in ((1_700_000, True), (10_000, False)):
        data = memoryview(struct.pack('<I', count) + bytes(of_one * count))
        if refused:
            with pytest.raises(BrokenFile, match='could exceed the memory when deserialised'):
                read(data)
        else:
            assert len(read(data).transforms) == count


def test_sequences_of_messages_are_read():
    assert [inner.x for inner in outer(3, 'uint8 x', 3).all] == [0, 0, 0]
