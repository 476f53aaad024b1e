"""Publishers and subscriptions of ROS topics on DDS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import os
from pathlib import Path
import re
from typing import Any, Self

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import (
    DDSException,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from djet_ros.dds.wire import dds_type_name, decode, encode, sample_type
from djet_ros.errors import DjetError
from djet_ros.live.middleware import DEFAULT_PROFILE, Offer, Profile
from djet_ros.recordings.decoding import jazzy

# A write holds Python's interpreter lock; whoever has to wait longer asks again.
_MAX_BLOCKING = duration(milliseconds=20)

# Samples that who keeps all may hold, at either end, before the publisher has to wait.
_KEEP_ALL_ROOM = 32

_GONE = (DDSException.DDS_RETCODE_BAD_PARAMETER, DDSException.DDS_RETCODE_ALREADY_DELETED)

_ANY = ViewState.Any | InstanceState.Any | SampleState.NotRead

# As ROS does, but with the loopback interface by name: from another, Cyclone 11 does not hear a
# ROS with Cyclone 0.10. And datagrams as large as loopback takes them: an image is 8 and not 300.
_LOCALHOST = """\
<CycloneDDS><Domain>
  <General>
    {interfaces}
    <AllowMulticast>false</AllowMulticast>
    <MaxMessageSize>65500B</MaxMessageSize><FragmentSize>60000B</FragmentSize>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer address="localhost"/>{peers}</Peers>
  </Discovery>
</Domain></CycloneDDS>,"""

_LOOPBACK = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'

_SUBNET = """\
<CycloneDDS><Domain><Discovery>
  <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
  <Peers>{peers}</Peers>
</Discovery></Domain></CycloneDDS>,"""

_OFF = """\
<CycloneDDS><Domain>
  <General><AllowMulticast>false</AllowMulticast></General>
  <Discovery>
    <ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{pid}</Tag>
  </Discovery>
</Domain></CycloneDDS>,"""

_RANGES = {'LOCALHOST': _LOCALHOST, 'SUBNET': _SUBNET, 'OFF': _OFF, 'SYSTEM_DEFAULT': ''}


class Publisher:
    """Publishes messages of one type on one topic; may be used from any thread."""

    def __init__(self, writer: DataWriter, sample: Any) -> None:
        self._writer = writer
        self._sample = sample

    def publish(self, message: Any) -> bool:
        """Send a message; False where the subscriptions left no room for it for a moment."""
        return self.send(encode(message))

    def send(self, data: bytes) -> bool:
        """Send a message in CDR; see ``publish``."""
        try:
            self._writer.write(self._sample(data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            return False
        return True

    @property
    def listeners(self) -> int:
        """Count the subscriptions; none once the graph is closed."""
        try:
            return len(self._writer.get_matched_subscriptions())
        except DDSException as error:
            if error.code not in _GONE:
                raise
            return 0

    def listens(self, user_data: str) -> bool:
        """Tell whether a subscription says this of itself."""
        return any(user_data in _user_data(self._writer.get_matched_subscription_data(handle))
                   for handle in self._writer.get_matched_subscriptions())

    def wait_until_taken(self, seconds: float) -> bool:
        """Wait until all reliable subscriptions have everything."""
        try:
            return bool(self._writer.wait_for_acks(duration(seconds=seconds)))
        except AttributeError:
            # Cyclone 11.0.1 looks the code of its own timeout up in the wrong class.
            return False


class Subscription:
    """Hands messages of one topic to a callback; the callbacks are called by Graph.spin."""

    def __init__(self, reader: DataReader, topic: str, profile: Profile, batch: int,
                 callback: Callable[[Any, Any], None], ready: Callable[[], bool] | None) -> None:
        self.topic = topic
        self.profile = profile
        self.waited_for = False
        self._reader = reader
        self._batch = batch
        self._callback = callback
        self._ready = ready
        self._garbage = 0
        self.condition = ReadCondition(reader, _ANY)

    @property
    def ready(self) -> bool:
        """Whether messages are to be taken now."""
        return self._ready is None or self._ready()

    def dispatch(self) -> None:
        """Hand out what has come, up to the size of a batch."""
        if not self.ready:
            return
        for sample in self._reader.take(self._batch, self.condition):
            if sample.sample_info.valid_data:
                self._callback(sample.data, sample.sample_info)

    def count_garbage(self) -> None:
        """Count a sample that is no message of its type as one that never came."""
        self._garbage += 1

    def new_losses(self) -> int:
        """Count the messages that were lost on the way since the last call."""
        number, self._garbage = self._garbage, 0
        return number + int(self._reader.get_sample_lost_status().total_count_change)

    def new_refusals(self) -> int:
        """Count the publishers that turned up since the last call and do not fit."""
        return int(self._reader.get_requested_incompatible_qos_status().total_count_change)

    def user_data_of(self, info: Any) -> str:
        """Give what the publisher of a sample says of itself."""
        return _user_data(self._reader.get_matched_publication_data(info.publication_handle))


class Graph:
    """
    A participant in the ROS graph, with the domain and range that the environment asks for.

    Reads ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS and CYCLONEDDS_URI, as
    ROS does with Cyclone DDS. Raises DjetError where one of them can't be used.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        domain = _domain_id(environment)
        try:
            self._domain = Domain(domain, _configuration(environment))
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise DjetError(f'no DDS participant in domain {domain}: {error.msg}; check '
                            'CYCLONEDDS_URI and the network interfaces') from None
        self._subscriptions: list[Subscription] = []
        self._waiting = WaitSet(self._participant)
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._listeners = BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription)

    def close(self) -> None:
        """Leave the graph, and tell the others; nothing can be sent or heard any more."""
        # Cyclone deletes what Python has forgotten, and at its exit Python forgets nothing: the
        # others would take this participant for alive until its lease ends.
        self._participant.__del__()
        # And where a domain is left behind, the process can't enter it again.
        self._domain.__del__()

    def __enter__(self) -> Self:
        """Give the graph itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self.close()

    def advertise(self, topic: str, ros_type: str,
                  profile: Profile = DEFAULT_PROFILE) -> Publisher:
        """Publish on a topic from now on."""
        return self.advertise_raw(f'rt{topic}', dds_type_name(ros_type), profile,
                                  _type_hash(ros_type))

    def advertise_raw(self, dds_topic: str, dds_type: str, profile: Profile,
                      user_data: str) -> Publisher:
        """Publish on a topic under its DDS names."""
        sample = sample_type(dds_type)
        writer = DataWriter(self._participant, Topic(self._participant, dds_topic, sample),
                            _qos(profile, user_data))
        return Publisher(writer, sample)

    def listen(self, topic: str, ros_type: str, callback: Callable[[Any], None],
               profile: Profile = DEFAULT_PROFILE, *, batch: int = 100,
               garbage: Callable[[str], None] = lambda reason: None,
               ready: Callable[[], bool] | None = None) -> Subscription:
        """
        Hand the messages on a topic to a callback.

        batch: how many at most before it is the turn of other topics; garbage: is told of each
        sample that is no such message, and why; ready: see ``Middleware.listen``.
        """
        def take(data: bytes, _: Any) -> None:
            try:
                message = decode(data, ros_type)
            except DjetError as error:
                subscription.count_garbage()
                garbage(f'a message on {topic} could not be read: {error}')
                return
            callback(message)

        subscription = self.listen_raw(f'rt{topic}', dds_type_name(ros_type), take, profile,
                                       _type_hash(ros_type), batch, ready)
        subscription.topic = topic
        return subscription

    def listen_raw(self, dds_topic: str, dds_type: str, callback: Callable[[Any, Any], None],
                   profile: Profile, user_data: str, batch: int = 100,
                   ready: Callable[[], bool] | None = None) -> Subscription:
        """Hand CDR and sample information on a topic, under its DDS names, to a callback."""
        reader = DataReader(self._participant,
                            Topic(self._participant, dds_topic, sample_type(dds_type)),
                            _qos(profile, user_data))
        subscription = Subscription(reader, dds_topic, profile, batch, callback, ready)
        self._subscriptions.append(subscription)
        return subscription

    def spin(self, seconds: float) -> None:
        """Wait for messages, at most for some time, and hand them out in order of listening."""
        for subscription in self._subscriptions:
            self._wait_for(subscription, wanted=subscription.ready)
        self._waiting.wait(duration(seconds=seconds))
        for subscription in list(self._subscriptions):
            subscription.dispatch()

    def _wait_for(self, subscription: Subscription, *, wanted: bool) -> None:
        """Be woken up by messages, or not: those that are not taken would do so at once."""
        if wanted != subscription.waited_for:
            subscription.waited_for = wanted
            change = self._waiting.attach if wanted else self._waiting.detach
            change(subscription.condition)

    def offers(self, topic: str) -> list[Offer]:
        """Give who publishes a topic."""
        return [Offer(f'participant {one.participant_key}', _ros_type(one.type_name),
                      _profile(one.qos)) for one in _alive(self._publications)
                if one.topic_name == f'rt{topic}']

    def listeners_without(self, dds_topic: str, user_data: str) -> set[str]:
        """Give who subscribes to a topic, by its DDS name, and does not say this of itself."""
        return {str(one.key) for one in _alive(self._listeners)
                if one.topic_name == dds_topic and user_data not in _user_data(one)}

    def published(self, ros_type: str) -> list[str]:
        """Give the topics over which somebody sends messages of a ROS type."""
        return sorted({one.topic_name.removeprefix('rt') for one in _alive(self._publications)
                       if one.topic_name.startswith('rt/')
                       and one.type_name == dds_type_name(ros_type)})


def _alive(reader: BuiltinDataReader) -> list[Any]:
    return [one for one in reader.read(1000)
            if one.sample_info.instance_state == InstanceState.Alive]


def _domain_id(environment: Mapping[str, str]) -> int:
    text = environment.get('ROS_DOMAIN_ID') or '0'
    if not text.isdecimal() or int(text) > 232:
        raise DjetError(f"ROS_DOMAIN_ID is '{text}'; it must be a number from 0 to 232")
    return int(text)


def _configuration(environment: Mapping[str, str]) -> str:
    # ROS before Iron knew this one alone. Later ones still take it, and it prevails.
    only = environment.get('ROS_LOCALHOST_ONLY', '').startswith('1')
    name = 'LOCALHOST' if only else environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'SUBNET'
    if name not in _RANGES:
        raise DjetError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{name}'; choose from "
                        f'{", ".join(_RANGES)}')
    named = '' if only else environment.get('ROS_STATIC_PEERS', '')
    peers = ''.join(f'<Peer address="{peer}"/>' for peer in named.split(';') if peer)
    # What the user says comes last and counts; but interfaces add up, and none may come twice.
    uri = environment.get('CYCLONEDDS_URI', '')
    interfaces = '' if _chooses_interfaces(uri) else _LOOPBACK
    return _RANGES[name].format(interfaces=interfaces, peers=peers, pid=os.getpid()) + uri


def _chooses_interfaces(uri: str) -> bool:
    """Tell whether a Cyclone configuration, which is XML or names of files, chooses interfaces."""
    files = [Path(name) for name in re.findall('file://([^,]+)', uri)]
    texts = [uri, *(file.read_text('utf-8', 'replace') for file in files if file.is_file())]
    return any('<NetworkInterface' in text for text in texts)


def _ros_type(dds_name: str) -> str:
    """Give the ROS type such as 'sensor_msgs/msg/Image' of a DDS type."""
    return dds_name.replace('::dds_::', '/').replace('::', '/').removesuffix('_')


def _type_hash(ros_type: str) -> str:
    return f'typehash={jazzy().hash_rihs01(ros_type)};'


def _qos(profile: Profile, user_data: str = '') -> Qos:
    """Quality of service in DDS's words; user_data is what ROS tells its peers in addition."""
    return Qos(
        Policy.Reliability.Reliable(_MAX_BLOCKING) if profile.reliable
        else Policy.Reliability.BestEffort,
        Policy.History.KeepAll if profile.depth is None
        else Policy.History.KeepLast(profile.depth),
        Policy.Durability.TransientLocal if profile.latched else Policy.Durability.Volatile,
        Policy.ResourceLimits(max_samples=-1 if profile.depth else _KEEP_ALL_ROOM),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(user_data.encode()))


def _profile(qos: Qos) -> Profile:
    return Profile(reliable=isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable),
                   latched=qos[Policy.Durability] != Policy.Durability.Volatile)


def _user_data(endpoint: Any) -> str:
    if endpoint is None or Policy.Userdata not in endpoint.qos:
        return ''
    return bytes(endpoint.qos[Policy.Userdata].data).decode(errors='replace')
