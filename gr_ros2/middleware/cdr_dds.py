"""The only module that uses the symbols of the DDS library: whole CDR messages in and out, no message definition.

A topic is declared with a descriptor of one octet. The library keeps what follows that octet untouched, so any
type passes as opaque bytes, under whatever type name the topic carries. Most functions used are the library's
documented C API (dds.h); those of the serdata family are not, and the layouts here are those of version 11.0.

Invariants: entities are plain integers and every function may be called from any thread; calls that may wait release
the GIL; every error of the library is a DdsError that names call and code. Calls with an entity that another thread has
deleted fail, but never crash.
"""

from __future__ import annotations

import ctypes as c
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from gr_ros2.core.errors import MiddlewareError
from gr_ros2.middleware import dds_library
from gr_ros2.middleware.base import Qos, finite

Entity = int
"""Handle of an object of the library."""

BATCH = 64
"""Samples taken from a reader in one call."""
MIN_PAYLOAD = 5
"""Bytes of the smallest message: the encapsulation header and one octet."""

_INFINITY = 2**63 - 1
_ALIVE = 16
_ANY_STATE = 0x7F
_KEY_OR_DATA = 2
_PUBLICATIONS, _SUBSCRIPTIONS = 0x7FFF0003, 0x7FFF0004
"""Pseudo topics DCPSPublication and DCPSSubscription."""
_BLOCK_NS = 1_000_000_000
"""A reliable write waits this long for a subscriber that does not keep up."""
_OFFERED_INCOMPATIBLE, _REQUESTED_INCOMPATIBLE, _SAMPLE_LOST = 1 << 3, 1 << 4, 1 << 5
_PUBLICATION_MATCHED, _SUBSCRIPTION_MATCHED = 1 << 11, 1 << 12
_MOST_MATCHES = 256
"""Endpoints matched by one endpoint that are looked at."""

_CYCLONE = bytes((1, 16))
"""Vendor id of Cyclone DDS. In the standard, history is not part of a publisher's discovery data (Fast DDS does not
send it, and would be read as KeepLast 1); Cyclone DDS sends it."""

_POLICIES = {
    2: "durability",
    3: "presentation",
    4: "deadline",
    5: "latency_budget",
    6: "ownership",
    8: "liveliness",
    10: "partition",
    11: "reliability",
    12: "destination_order",
    23: "data_representation",
    24: "type_consistency",
}


class DdsError(MiddlewareError):
    """The library refused a call. ``code`` is its return code, negative."""

    def __init__(self, what: str, code: int) -> None:
        reason = _strretcode(-code)
        super().__init__(f"{what}: DDS says {reason.decode() if reason else 'error'} ({code})")
        self.code = code

    @property
    def timeout(self) -> bool:
        """The call did not end in the time that it was given."""
        return self.code == -10

    @property
    def gone(self) -> bool:
        """The entity was deleted (bad parameter, or already deleted)."""
        return self.code in (-3, -9)


class _Serialized(c.Structure):
    _fields_ = [("data", c.c_void_p), ("size", c.c_uint32)]


class _Descriptor(c.Structure):
    """dds_topic_descriptor_t."""

    _fields_ = [
        ("size", c.c_uint32),
        ("align", c.c_uint32),
        ("flags", c.c_uint32),
        ("key_count", c.c_uint32),
        ("type_name", c.c_char_p),
        ("keys", c.c_void_p),
        ("op_count", c.c_uint32),
        ("ops", c.POINTER(c.c_uint32)),
        ("meta", c.c_char_p),
        ("type_information", _Serialized),
        ("type_mapping", _Serialized),
        ("restrict_representation", c.c_uint32),
    ]


class _SampleInfo(c.Structure):
    """dds_sample_info_t."""

    _fields_ = [
        ("sample_state", c.c_int32),
        ("view_state", c.c_int32),
        ("instance_state", c.c_int32),
        ("valid", c.c_bool),
        ("source_timestamp", c.c_int64),
        ("instance_handle", c.c_uint64),
        ("publication_handle", c.c_uint64),
        ("ranks", c.c_uint32 * 5),
    ]


class _Buffer(c.Structure):
    """struct iovec."""

    _fields_ = [("base", c.c_char_p), ("length", c.c_size_t)]


class _BuiltinEndpoint(c.Structure):
    """dds_builtintopic_endpoint_t."""

    _fields_ = [
        ("key", c.c_uint8 * 16),
        ("participant_key", c.c_uint8 * 16),
        ("participant_handle", c.c_uint64),
        ("topic_name", c.c_char_p),
        ("type_name", c.c_char_p),
        ("qos", c.c_void_p),
    ]


class _Status(c.Structure):
    """The first fields of all status structures; the rest depends on the kind."""

    _fields_ = [
        ("total", c.c_uint32),
        ("change", c.c_int32),
        ("third", c.c_uint32),
        ("rest", c.c_uint32 * 5),
    ]


_LIBRARY = dds_library.load()


_BRIEF = c.PyDLL(_LIBRARY._name, handle=_LIBRARY._handle)
"""The same for calls that never wait: they keep Python's lock. On a computer that is too slow a thread waits for every
lock that it gives up, and a message takes seven calls; the library calls no Python, so nothing inside it waits for that
lock."""


def _function(name: str, result: Any, *arguments: Any, library: c.CDLL = _LIBRARY) -> Any:
    function = library[name]
    function.restype, function.argtypes = result, list(arguments)
    return function


_brief = partial(_function, library=_BRIEF)


_i32, _u32, _i64, _ptr, _size = c.c_int32, c.c_uint32, c.c_int64, c.c_void_p, c.c_size_t

_strretcode = _function("dds_strretcode", c.c_char_p, _i32)  # codes to words
_create_domain = _function("dds_create_domain", _i32, _u32, c.c_char_p)  # a domain with our own configuration
_lookup_participant = _function("dds_lookup_participant", _i32, _u32, _ptr, _size)  # who else is in a domain
_create_participant = _function("dds_create_participant", _i32, _u32, _ptr, _ptr)
_create_topic = _function("dds_create_topic", _i32, _i32, c.POINTER(_Descriptor), c.c_char_p, _ptr, _ptr)
_create_reader = _function("dds_create_reader", _i32, _i32, _i32, _ptr, _ptr)
_create_writer = _function("dds_create_writer", _i32, _i32, _i32, _ptr, _ptr)
_create_readcondition = _function("dds_create_readcondition", _i32, _i32, _u32)  # true while samples wait
_create_guardcondition = _function("dds_create_guardcondition", _i32, _i32)  # wakes a waiting thread
_set_guardcondition = _brief("dds_set_guardcondition", _i32, _i32, c.c_bool)
_take_guardcondition = _brief("dds_take_guardcondition", _i32, _i32, c.POINTER(c.c_bool))
_create_waitset = _function("dds_create_waitset", _i32, _i32)
_waitset_attach = _function("dds_waitset_attach", _i32, _i32, _i32, c.c_ssize_t)
_waitset_wait = _function("dds_waitset_wait", _i32, _i32, c.POINTER(c.c_ssize_t), _size, _i64)
_delete = _function("dds_delete", _i32, _i32)
_get_guid = _function("dds_get_guid", _i32, _i32, c.c_char_p)
_set_status_mask = _function("dds_set_status_mask", _i32, _i32, _u32)  # which statuses wake the waitset
_take = _function("dds_take", _i32, _i32, c.POINTER(_ptr), c.POINTER(_SampleInfo), _size, _u32)  # built-in topics
_return_loan = _function("dds_return_loan", _i32, _i32, c.POINTER(_ptr), _i32)
_takecdr = _brief("dds_takecdr", _i32, _i32, c.POINTER(_ptr), _u32, c.POINTER(_SampleInfo), _u32)
_writecdr = _function("dds_writecdr", _i32, _i32, _ptr)  # consumes the serdata, whatever it returns
_get_sertype = _function("dds_get_entity_sertype", _i32, _i32, c.POINTER(_ptr))  # a serdata is made for its type
_serdata_from = _brief("ddsi_serdata_from_ser_iov", _ptr, _ptr, c.c_int, _size, c.POINTER(_Buffer), _size)
_serdata_size = _brief("ddsi_serdata_size", _u32, _ptr)
_serdata_to = _brief("ddsi_serdata_to_ser", None, _ptr, _size, _size, _ptr)
_serdata_unref = _brief("ddsi_serdata_unref", None, _ptr)
_matched_endpoints = {
    name: (
        _function(f"dds_get_matched_{name}s", _i32, _i32, c.POINTER(c.c_uint64), _size),
        _function(f"dds_get_matched_{name}_data", c.POINTER(_BuiltinEndpoint), _i32, c.c_uint64),
    )
    for name in ("publication", "subscription")
}  # handles, and what discovery says of one
_free_endpoint = _function("dds_builtintopic_free_endpoint", None, c.POINTER(_BuiltinEndpoint))
_create_qos = _function("dds_create_qos", _ptr)
_delete_qos = _function("dds_delete_qos", None, _ptr)
_set_userdata = _function("dds_qset_userdata", None, _ptr, c.c_char_p, _size)  # enclave and type hash of ROS
_set_reliability = _function("dds_qset_reliability", None, _ptr, c.c_int, _i64)
_set_durability = _function("dds_qset_durability", None, _ptr, c.c_int)
_set_history = _function("dds_qset_history", None, _ptr, c.c_int, _i32)
_set_limits = _function("dds_qset_resource_limits", None, _ptr, _i32, _i32, _i32)
_set_durability_service = _function(
    "dds_qset_durability_service", None, _ptr, _i64, c.c_int, _i32, _i32, _i32, _i32
)  # what a late joiner gets: without it one sample only
_set_lifecycle = _function("dds_qset_writer_data_lifecycle", None, _ptr, c.c_bool)
_set_representation = _function("dds_qset_data_representation", None, _ptr, _u32, c.POINTER(c.c_int16))
_get_userdata = _function("dds_qget_userdata", c.c_bool, _ptr, c.POINTER(_ptr), c.POINTER(_size))
_free = _function("dds_free", None, _ptr)  # of what the library allocated for us
_get_reliability = _function("dds_qget_reliability", c.c_bool, _ptr, c.POINTER(c.c_int), c.POINTER(_i64))
_get_durability = _function("dds_qget_durability", c.c_bool, _ptr, c.POINTER(c.c_int))
_set_lifespan = _function("dds_qset_lifespan", None, _ptr, _i64)
_set_deadline = _function("dds_qset_deadline", None, _ptr, _i64)
_get_history = _function("dds_qget_history", c.c_bool, _ptr, c.POINTER(c.c_int), c.POINTER(_i32))
_get_lifespan = _function("dds_qget_lifespan", c.c_bool, _ptr, c.POINTER(_i64))
_get_deadline = _function("dds_qget_deadline", c.c_bool, _ptr, c.POINTER(_i64))
_status = {
    name: _brief(f"dds_get_{name}_status", _i32, _i32, c.POINTER(_Status))
    for name in (
        "publication_matched",
        "subscription_matched",
        "offered_incompatible_qos",
        "requested_incompatible_qos",
        "sample_lost",
    )
}

_OCTET = (c.c_uint32 * 3)(0x01010000, 0, 0)
"""The library's type program: one member of one byte at offset 0, end."""


def _checked(code: int, what: str) -> int:
    if code < 0:
        raise DdsError(what, code)
    return code


def create_domain(domain_id: int, configuration: str) -> Entity:
    """Open a domain configured by XML; fails where this process has the domain open already."""
    return _checked(_create_domain(domain_id, configuration.encode()), f"open domain {domain_id}")


def participants_in(domain_id: int) -> int:
    """Number of participants this process has in a domain."""
    return max(0, int(_lookup_participant(domain_id, None, 0)))


def create_participant(domain_id: int, user_data: bytes) -> Entity:
    """A participant in a domain, with user data that others see.

    :raises DdsError: the domain cannot be joined
    """
    qos = _create_qos()
    try:
        _set_userdata(qos, user_data, len(user_data))
        return _checked(_create_participant(domain_id, qos, None), f"join domain {domain_id}")
    finally:
        _delete_qos(qos)


def create_topic(participant: Entity, name: str, type_name: str) -> Entity:
    """A topic of opaque messages: names as on DDS, XCDR1 only, no type information announced."""
    descriptor = _Descriptor(1, 1, 1 << 7, 0, type_name.encode(), None, 3, _OCTET, b"", _Serialized(), _Serialized(), 1)
    code = _create_topic(participant, c.byref(descriptor), name.encode(), None, None)
    return _checked(code, f"declare topic {name} of type {type_name}")


def delete(entity: Entity) -> None:
    """Delete an entity and its children; an entity that is deleted already is not an error."""
    _delete(entity)


def guid(entity: Entity) -> bytes:
    """The 16-byte GUID of a participant, reader or writer."""
    data = c.create_string_buffer(16)
    _checked(_get_guid(entity, data), "ask for a GUID")
    return data.raw


def _make_qos(qos: Qos, user_data: bytes) -> int:
    history = (1, 0) if qos.depth == 0 else (0, qos.depth)
    pointer = _create_qos()
    _set_reliability(pointer, int(qos.reliability == "reliable"), _BLOCK_NS)
    _set_durability(pointer, int(qos.durability == "transient_local"))
    _set_history(pointer, *history)
    _set_limits(pointer, -1, -1, -1)
    _set_durability_service(pointer, 0, *history, -1, -1, -1)
    _set_lifecycle(pointer, False)  # a publisher that leaves does not dispose its published messages
    _set_representation(pointer, 1, c.byref(c.c_int16(0)))
    if qos.lifespan_s:
        _set_lifespan(pointer, int(qos.lifespan_s * 1e9))
    if qos.deadline_s:
        _set_deadline(pointer, int(qos.deadline_s * 1e9))
    if user_data:
        _set_userdata(pointer, user_data, len(user_data))
    return int(pointer)


def _read_qos(pointer: int, key: bytes) -> Qos:
    """The QoS of the endpoint with that GUID, whose first bytes are the vendor id of its DDS."""
    reliability, durability, history, depth = c.c_int(0), c.c_int(0), c.c_int(0), _i32(1)
    lifespan, deadline = _i64(0), _i64(0)
    _get_reliability(pointer, c.byref(reliability), c.byref(_i64(0)))
    _get_durability(pointer, c.byref(durability))
    _get_history(pointer, c.byref(history), c.byref(depth))
    _get_lifespan(pointer, c.byref(lifespan))
    _get_deadline(pointer, c.byref(deadline))
    return Qos(
        "reliable" if reliability.value == 1 else "best_effort",
        "transient_local" if durability.value >= 1 else "volatile",
        (0 if history.value == 1 else depth.value) if key.startswith(_CYCLONE) else Qos().depth,
        finite(lifespan.value * 1e-9),
        finite(deadline.value * 1e-9),
    )


def _read_user_data(pointer: int) -> bytes:
    value, size = _ptr(), _size(0)
    _get_userdata(pointer, c.byref(value), c.byref(size))
    data = c.string_at(value, size.value)  # b"" of no address and no bytes
    _free(value)
    return data


@dataclass(frozen=True)
class DiscoveredEndpoint:
    """A publisher or subscriber of the graph, with names as on DDS."""

    key: bytes
    participant: bytes
    topic: str
    type_name: str
    qos: Qos
    user_data: bytes = b""

    @property
    def is_cyclone(self) -> bool:
        """Whether its DDS is Cyclone DDS."""
        return self.key.startswith(_CYCLONE)


def _discovered(data: Any) -> DiscoveredEndpoint:
    """The content of a ``_BuiltinEndpoint``."""
    key = bytes(data.key)
    topic, type_name = data.topic_name.decode(errors="replace"), data.type_name.decode(errors="replace")
    qos, user_data = _read_qos(data.qos, key), _read_user_data(data.qos)
    return DiscoveredEndpoint(key, bytes(data.participant_key), topic, type_name, qos, user_data)


class _Endpoint:
    """Common part of readers and writers. ``incompatible`` and ``matched`` ask the library."""

    _matched_status = ""
    _incompatible_status = ""
    _others = ""
    """The endpoints that it matches: publications or subscriptions."""
    _matches = 0
    """The status of its matches."""

    def __init__(self, create: Any, participant: Entity, topic: Entity, qos: Qos, user_data: bytes) -> None:
        pointer = _make_qos(qos, user_data)
        try:
            self.entity: Entity = _checked(create(participant, topic, pointer, None), "create an endpoint")
        finally:
            _delete_qos(pointer)
        self.guid = guid(self.entity)

    def watch_matches(self) -> None:
        """Trigger a waitset whenever endpoints of the other side come or leave."""
        _checked(_set_status_mask(self.entity, self._matches), "set a status mask")

    def _get(self, status: str) -> _Status:
        value = _Status()
        _checked(_status[status](self.entity, c.byref(value)), f"ask for {status}")
        return value

    def matched(self) -> int:
        """Number of endpoints on the other side currently matched."""
        return int(self._get(self._matched_status).third)

    def others(self) -> list[DiscoveredEndpoint]:
        """The endpoints on the other side that are matched."""
        handles = (c.c_uint64 * _MOST_MATCHES)()
        found = _checked(_matched_endpoints[self._others][0](self.entity, handles, _MOST_MATCHES), "ask for matches")
        endpoints = [self.other(handle) for handle in handles[: min(found, _MOST_MATCHES)]]
        return [endpoint for endpoint in endpoints if endpoint is not None]

    def other(self, handle: int) -> DiscoveredEndpoint | None:
        """A matched endpoint on the other side, for instance the ``source`` of a sample; None if it has left."""
        pointer = _matched_endpoints[self._others][1](self.entity, handle)
        if not pointer:
            return None
        try:
            return _discovered(pointer.contents)
        finally:
            _free_endpoint(pointer)

    def incompatible(self) -> tuple[int, str]:
        """Number of endpoints refused for incompatible QoS since the last call, and the policy of the last one."""
        value = self._get(self._incompatible_status)
        return int(value.change), _POLICIES.get(value.third, f"policy_{value.third}")

    def delete(self) -> None:
        delete(self.entity)


class Sample(NamedTuple):
    """One message; ``source`` and ``stamp`` (ns) identify it among all readers of this process."""

    payload: bytes
    source: int
    stamp: int


class RawReader(_Endpoint):
    """Takes whole messages. Only one thread may use it at a time."""

    _matched_status = "subscription_matched"
    _others = "publication"
    _incompatible_status = "requested_incompatible_qos"
    _matches = _SUBSCRIPTION_MATCHED

    def __init__(self, participant: Entity, topic: Entity, qos: Qos, user_data: bytes = b"") -> None:
        super().__init__(_create_reader, participant, topic, qos, user_data)
        self.latched = qos.durability == "transient_local"
        self.brings_past = self.latched and qos.reliability == "reliable"
        _checked(_set_status_mask(self.entity, _REQUESTED_INCOMPATIBLE | _SAMPLE_LOST), "set a status mask")
        self.condition: Entity = _checked(_create_readcondition(self.entity, _ANY_STATE), "create a condition")
        self._samples = (c.c_void_p * BATCH)()
        self._infos = (_SampleInfo * BATCH)()
        self._scratch = c.create_string_buffer(4096)

    def take(self) -> list[Sample]:
        """Up to BATCH messages that wait, oldest first."""
        taken = _checked(_takecdr(self.entity, self._samples, BATCH, self._infos, _ANY_STATE), "take samples")
        messages = []
        for index in range(taken):
            serdata, info = self._samples[index], self._infos[index]
            if info.valid:
                size = _serdata_size(serdata)
                if size > len(self._scratch):
                    self._scratch = c.create_string_buffer(2 * size)
                _serdata_to(serdata, 0, size, self._scratch)
                payload = c.string_at(self._scratch, size)
                messages.append(Sample(payload, info.publication_handle, info.source_timestamp))
            _serdata_unref(serdata)
            self._samples[index] = None
        return messages

    def lost(self) -> int:
        """Samples that the library reports as lost since the last call.

        It reports samples that came too late for the order, but not gaps of a best-effort publisher (documented by
        Cyclone DDS, and observed with 11.0.1).
        """
        return int(self._get("sample_lost").change)


class RawWriter(_Endpoint):
    """Writes whole messages, from any thread."""

    _matched_status = "publication_matched"
    _others = "subscription"
    _incompatible_status = "offered_incompatible_qos"
    _matches = _PUBLICATION_MATCHED

    def __init__(self, participant: Entity, topic: Entity, qos: Qos, user_data: bytes = b"") -> None:
        super().__init__(_create_writer, participant, topic, qos, user_data)
        _checked(_set_status_mask(self.entity, _OFFERED_INCOMPATIBLE), "set a status mask")
        sertype = c.c_void_p()
        _checked(_get_sertype(self.entity, c.byref(sertype)), "ask for a type")
        self._sertype = sertype

    def write(self, payload: bytes) -> None:
        """Send one message, zero-padded to a multiple of 4 (the library would pad with uninitialised memory).

        :raises MiddlewareError: not a CDR message
        :raises DdsError: the writer is deleted, or a reliable subscriber did not take the message within a second
        """
        payload = payload.ljust((len(payload) + 3) // 4 * 4, b"\0")
        serdata = None
        if len(payload) >= MIN_PAYLOAD:
            buffer = _Buffer(payload, len(payload))
            serdata = _serdata_from(self._sertype, _KEY_OR_DATA, 1, c.byref(buffer), len(payload))
        if not serdata:
            head = payload[:4].hex(" ")
            raise MiddlewareError(f"message of {len(payload)} bytes, {head} …, is not CDR; not published")
        _checked(_writecdr(self.entity, serdata), "publish")


class EndpointWatch:
    """Discovery of publishers or subscribers, those of this participant included."""

    def __init__(self, participant: Entity, *, publishers: bool) -> None:
        topic = _PUBLICATIONS if publishers else _SUBSCRIPTIONS
        self.entity: Entity = _checked(_create_reader(participant, topic, None, None), "watch the graph")
        self.condition: Entity = _checked(_create_readcondition(self.entity, _ANY_STATE), "create a condition")

    def take(self) -> list[tuple[bytes, DiscoveredEndpoint | None]]:
        """The changes: key and endpoint, None where it left."""
        samples, infos = (c.c_void_p * BATCH)(), (_SampleInfo * BATCH)()
        taken = _checked(_take(self.entity, samples, infos, BATCH, BATCH), "take discovery")
        changes: list[tuple[bytes, DiscoveredEndpoint | None]] = []
        for index in range(taken):
            data = c.cast(c.c_void_p(samples[index]), c.POINTER(_BuiltinEndpoint)).contents
            key = bytes(data.key)
            there = infos[index].valid and infos[index].instance_state == _ALIVE
            changes.append((key, _discovered(data) if there else None))
        if taken:
            _return_loan(self.entity, samples, taken)
        return changes


class WaitSet:
    """One thread waits for many entities; each is attached with a number that identifies it when it triggers."""

    _CAPACITY = 256

    def __init__(self, participant: Entity) -> None:
        self._waitset = _checked(_create_waitset(participant), "create a waitset")
        self._guard = _checked(_create_guardcondition(participant), "create a guard")
        self.attach(self._guard, 0)
        self._triggered = (c.c_ssize_t * self._CAPACITY)()

    def attach(self, entity: Entity, number: int) -> None:
        """:param number: positive; an entity that is deleted detaches itself"""
        _checked(_waitset_attach(self._waitset, entity, number), "attach to a waitset")

    def wait(self, timeout: float | None) -> set[int]:
        """Numbers of the entities that triggered; empty after ``timeout`` s or :meth:`wake`. None waits without
        limit."""
        limit = _INFINITY if timeout is None else int(timeout * 1e9)
        found = _checked(_waitset_wait(self._waitset, self._triggered, self._CAPACITY, limit), "wait")
        numbers = set(self._triggered[: min(found, self._CAPACITY)])
        if 0 in numbers:
            numbers.discard(0)
            _take_guardcondition(self._guard, c.byref(c.c_bool()))
        return numbers

    def wake(self) -> None:
        """Make :meth:`wait` return now, from any thread."""
        _set_guardcondition(self._guard, True)
