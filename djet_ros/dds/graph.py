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
from djet_ros.live.middleware import DEFAULT_PROFILE, Profile, PublisherInfo
from djet_ros.recordings.decoding import jazzy

# A blocked write holds Python's interpreter lock, so callers retry instead of waiting longer.
_MAX_BLOCKING = duration(milliseconds=20)

# Samples in a keep-all history, at either end, before the publisher blocks.
_KEEP_ALL_SAMPLES = 32

# Endpoints of a graph that are seen: a ROS node has about ten, and some per topic.
_MOST_ENDPOINTS = 1 << 16

_GONE = (DDSException.DDS_RETCODE_BAD_PARAMETER, DDSException.DDS_RETCODE_ALREADY_DELETED)

_ANY = ViewState.Any | InstanceState.Any | SampleState.NotRead

# As in ROS, but with the loopback interface by address: Cyclone 11 on another interface does not
# receive from a ROS with Cyclone 0.10. And with the largest datagrams that loopback takes: 8 for
# an image instead of 300.
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
    """Publishes one type on one topic; may be used from any thread."""

    def __init__(self, writer: DataWriter, sample: Any) -> None:
        self._writer = writer
        self._sample = sample

    def publish(self, message: Any) -> bool:
        """Publish a message; return False if a subscription has no room for it within 20 ms."""
        return self.send(encode(message))

    def send(self, data: bytes) -> bool:
        """Publish a serialised message (CDR); see ``publish``."""
        try:
            self._writer.write(self._sample(data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            return False
        return True

    @property
    def listeners(self) -> int:
        """Return the number of subscriptions; 0 once the graph is closed."""
        try:
            return len(self._writer.get_matched_subscriptions())
        except DDSException as error:
            if error.code not in _GONE:
                raise
            return 0

    def listens(self, user_data: str) -> bool:
        """Return whether a subscription has this text in its user data."""
        return any(user_data in _user_data(self._writer.get_matched_subscription_data(handle))
                   for handle in self._writer.get_matched_subscriptions())

    def wait_until_taken(self, seconds: float) -> bool:
        """Wait until all reliable subscriptions have acknowledged everything; return if so."""
        try:
            return bool(self._writer.wait_for_acks(duration(seconds=seconds)))
        except AttributeError:
            # Cyclone 11.0.1 looks up its timeout code in the wrong class.
            return False


class Subscription:
    """Passes the messages of one topic to a callback, which Graph.spin calls."""

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
        """Whether messages are taken now."""
        return self._ready is None or self._ready()

    def dispatch(self) -> None:
        """Call the callback for the samples received, up to the batch size."""
        if not self.ready:
            return
        for sample in self._reader.take(self._batch, self.condition):
            if sample.sample_info.valid_data:
                self._callback(sample.data, sample.sample_info)

    def count_garbage(self) -> None:
        """Count a sample that is not a message of its type as lost."""
        self._garbage += 1

    def new_losses(self) -> int:
        """Return the number of messages lost in transport since the last call."""
        number, self._garbage = self._garbage, 0
        return number + int(self._reader.get_sample_lost_status().total_count_change)

    def new_incompatible(self) -> int:
        """Return the number of publishers with incompatible QoS since the last call."""
        return int(self._reader.get_requested_incompatible_qos_status().total_count_change)

    def user_data_of(self, info: Any) -> str:
        """Return the user data of the publisher of a sample."""
        return _user_data(self._reader.get_matched_publication_data(info.publication_handle))


class Graph:
    """
    A participant in the ROS graph.

    Domain and discovery are those of ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE,
    ROS_STATIC_PEERS and CYCLONEDDS_URI, as in ROS with Cyclone DDS. Raises DjetError if one of
    them is invalid.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        domain = _domain_id(environment)
        try:
            self._domain = Domain(domain, _configuration(environment))
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise DjetError(f'no DDS participant could be created in domain {domain}: '
                            f'{error.msg}; check CYCLONEDDS_URI and the network '
                            'interfaces') from None
        self._subscriptions: list[Subscription] = []
        self._waiting = WaitSet(self._participant)
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._listeners = BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription)

    def close(self) -> None:
        """Leave the graph; nothing can be sent or received any more."""
        # Cyclone deletes entities only when Python collects them, which it does not do at exit:
        # to others this participant would be alive until its lease expires.
        self._participant.__del__()
        # A process cannot create a domain again unless it was deleted.
        self._domain.__del__()

    def __enter__(self) -> Self:
        """Return the graph itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self.close()

    def advertise(self, topic: str, ros_type: str,
                  profile: Profile = DEFAULT_PROFILE) -> Publisher:
        """Create a publisher of a ROS type on a topic."""
        return self.advertise_raw(f'rt{topic}', dds_type_name(ros_type), profile,
                                  _type_hash(ros_type))

    def advertise_raw(self, dds_topic: str, dds_type: str, profile: Profile,
                      user_data: str) -> Publisher:
        """Create a publisher by DDS topic and type names."""
        sample = sample_type(dds_type)
        writer = DataWriter(self._participant, Topic(self._participant, dds_topic, sample),
                            _qos(profile, user_data))
        return Publisher(writer, sample)

    def listen(self, topic: str, ros_type: str, callback: Callable[[Any], None],
               profile: Profile = DEFAULT_PROFILE, *, batch: int = 100,
               garbage: Callable[[str], None] = lambda reason: None,
               ready: Callable[[], bool] | None = None) -> Subscription:
        """
        Subscribe to a topic.

        batch: messages taken before other topics get their turn; garbage: called with the reason
        for each sample that cannot be deserialised; ready: see ``Middleware.listen``.
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
        """Subscribe by DDS names; the callback gets CDR bytes and sample information."""
        reader = DataReader(self._participant,
                            Topic(self._participant, dds_topic, sample_type(dds_type)),
                            _qos(profile, user_data))
        subscription = Subscription(reader, dds_topic, profile, batch, callback, ready)
        self._subscriptions.append(subscription)
        return subscription

    def spin(self, seconds: float) -> None:
        """Wait for messages for at most some seconds; call callbacks in order of subscription."""
        for subscription in self._subscriptions:
            self._wait_for(subscription, wanted=subscription.ready)
        self._waiting.wait(duration(seconds=seconds))
        for subscription in list(self._subscriptions):
            subscription.dispatch()

    def _wait_for(self, subscription: Subscription, *, wanted: bool) -> None:
        """Attach or detach a subscription: messages that are not taken would wake up at once."""
        if wanted != subscription.waited_for:
            subscription.waited_for = wanted
            change = self._waiting.attach if wanted else self._waiting.detach
            change(subscription.condition)

    def publishers_of(self, topic: str) -> list[PublisherInfo]:
        """Return the publishers of a topic."""
        return [PublisherInfo(f'participant {one.participant_key}', _ros_type(one.type_name),
                              _profile(one.qos)) for one in _alive(self._publications)
                if one.topic_name == f'rt{topic}']

    def listeners_without(self, dds_topic: str, user_data: str) -> set[str]:
        """Return the subscriptions to a DDS topic that lack a text in their user data."""
        return {str(one.key) for one in _alive(self._listeners)
                if one.topic_name == dds_topic and user_data not in _user_data(one)}

    def published(self, ros_type: str) -> list[str]:
        """Return the topics of a ROS type that have a publisher."""
        return sorted({one.topic_name.removeprefix('rt') for one in _alive(self._publications)
                       if one.topic_name.startswith('rt/')
                       and one.type_name == dds_type_name(ros_type)})


def _alive(reader: BuiltinDataReader) -> list[Any]:
    return [one for one in reader.read(_MOST_ENDPOINTS)
            if one.sample_info.instance_state == InstanceState.Alive]


def _domain_id(environment: Mapping[str, str]) -> int:
    text = environment.get('ROS_DOMAIN_ID') or '0'
    if not text.isdecimal() or int(text) > 232:
        raise DjetError(f"ROS_DOMAIN_ID is '{text}'; it must be an integer from 0 to 232")
    return int(text)


def _configuration(environment: Mapping[str, str]) -> str:
    # The variable of ROS before Iron; later versions still read it, and it takes precedence.
    only = environment.get('ROS_LOCALHOST_ONLY', '').startswith('1')
    name = 'LOCALHOST' if only else environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE') or 'SUBNET'
    if name not in _RANGES:
        raise DjetError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{name}'; choose from "
                        f'{", ".join(_RANGES)}')
    named = '' if only else environment.get('ROS_STATIC_PEERS', '')
    peers = ''.join(f'<Peer address="{peer}"/>' for peer in named.split(';') if peer)
    # The user's configuration comes last and overrides; but interfaces accumulate, and none may
    # be given twice.
    uri = environment.get('CYCLONEDDS_URI', '')
    interfaces = '' if _chooses_interfaces(uri) else _LOOPBACK
    return _RANGES[name].format(interfaces=interfaces, peers=peers, pid=os.getpid()) + uri


def _chooses_interfaces(uri: str) -> bool:
    """Return whether a Cyclone configuration (XML or file names) chooses interfaces."""
    files = [Path(name) for name in re.findall('file://([^,]+)', uri)]
    texts = [uri, *(file.read_text('utf-8', 'replace') for file in files if file.is_file())]
    return any('<NetworkInterface' in text for text in texts)


def _ros_type(dds_name: str) -> str:
    """Return the ROS type, such as 'sensor_msgs/msg/Image', of a DDS type."""
    return dds_name.replace('::dds_::', '/').replace('::', '/').removesuffix('_')


def _type_hash(ros_type: str) -> str:
    return f'typehash={jazzy().hash_rihs01(ros_type)};'


def _qos(profile: Profile, user_data: str = '') -> Qos:
    """Return the DDS QoS of a profile; user_data: what ROS adds for its peers."""
    return Qos(
        Policy.Reliability.Reliable(_MAX_BLOCKING) if profile.reliable
        else Policy.Reliability.BestEffort,
        Policy.History.KeepAll if profile.depth is None
        else Policy.History.KeepLast(profile.depth),
        Policy.Durability.TransientLocal if profile.latched else Policy.Durability.Volatile,
        Policy.ResourceLimits(max_samples=-1 if profile.depth else _KEEP_ALL_SAMPLES),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(user_data.encode()))


def _profile(qos: Qos) -> Profile:
    return Profile(reliable=isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable),
                   latched=qos[Policy.Durability] != Policy.Durability.Volatile)


def _user_data(endpoint: Any) -> str:
    if endpoint is None or Policy.Userdata not in endpoint.qos:
        return ''
    return bytes(endpoint.qos[Policy.Userdata].data).decode(errors='replace')
