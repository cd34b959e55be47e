"""A server or a client of AddTwoInts in another process: ``service_peer.py DOMAIN SERVICE server|client``.

Laid out as rmw_cyclonedds has it, by the typed Python API of Cyclone DDS, which shares no code with ours: 8 bytes of
client and a number before the message, ``serviceid=`` and ``clientid=`` in the user data.

A server says ``took A`` of each request and replies A + B. A client says ``servers N`` when their number has
changed, takes lines ``A B``, and says ``got NUMBER SUM``. Both say ``ready`` and end with their input.
"""

from __future__ import annotations

import sys
import threading
import uuid
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, annotations
from cyclonedds.idl.types import int64, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tests.said import say

PERIOD_S = 0.002


@annotations.final
@dataclass
class AddRequest(IdlStruct, typename="example_interfaces::srv::dds_::AddTwoInts_Request_"):
    guid: uint64
    seq: int64
    a: int64
    b: int64


@annotations.final
@dataclass
class AddReply(IdlStruct, typename="example_interfaces::srv::dds_::AddTwoInts_Response_"):
    guid: uint64
    seq: int64
    sum: int64


def endpoints(participant: DomainParticipant, service: str, role: str) -> tuple[Any, Any]:
    """Reader and writer of one end."""
    names = ((f"rq{service}Request", AddRequest), (f"rr{service}Reply", AddReply))
    requests, replies = (Topic(participant, name, kind) for name, kind in names)
    reads, writes = (requests, replies) if role == "server" else (replies, requests)
    key = "serviceid" if role == "server" else "clientid"
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"{key}={uuid.uuid4().hex};".encode()),
    )
    return DataReader(participant, reads, qos=qos), DataWriter(participant, writes, qos=qos)


def serve(reader: Any, writer: Any) -> None:
    for request in reader.take(100):
        if isinstance(request, AddRequest):
            say("took", request.a)
            writer.write(AddReply(request.guid, request.seq, request.a + request.b))


def main(domain: str, service: str, role: str) -> None:
    reader, writer = endpoints(DomainParticipant(int(domain)), service, role)
    over = threading.Event()
    own = uuid.uuid4().int >> 64

    def look() -> None:
        there = 0
        while not over.wait(PERIOD_S):
            if role == "server":
                serve(reader, writer)
                continue
            now = min(len(reader.get_matched_publications()), len(writer.get_matched_subscriptions()))
            if now != there:
                there = now
                say("servers", there)
            for reply in reader.take(100):
                if isinstance(reply, AddReply) and reply.guid == own:
                    say("got", f"{reply.seq} {reply.sum}")

    looker = threading.Thread(target=look)
    looker.start()
    say("ready")
    for number, line in enumerate(sys.stdin):
        a, b = map(int, line.split())
        writer.write(AddRequest(own, number, a, b))
    over.set()
    looker.join()


if __name__ == "__main__":
    main(*sys.argv[1:])
