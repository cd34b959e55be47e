"""The vectors of version 1, read by the engine's decoder and by the second one, which was made from the page alone."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from runpy import run_path
from typing import Any, cast

import pytest

from gr_ros2.calls.wish_frames import read_answer, read_offers, read_request
from gr_ros2.core.errors import WireError
from gr_ros2.link.events import Delivered
from gr_ros2.link.v1.announced import AnnouncedTopics
from gr_ros2.link.v1.decoder import RepairDecoder
from gr_ros2.link.v1.endpoint_settings import Settings
from gr_ros2.link.v1.gf256 import coefficient
from gr_ros2.link.v1.inbox import Inbox
from gr_ros2.link.v1.outcomes import Outcomes
from gr_ros2.link.v1.reassembly import Reassembly
from gr_ros2.link.v1.sealing import NOT_A_REPAIR, Keys, SealMode, subkey
from gr_ros2.wire import v1
from gr_ros2.wire.ages import age_code, age_of, limit_code
from gr_ros2.wire.mac_block import read_block
from gr_ros2.wire.relayed import (
    read_carried,
    read_receipts,
    read_relayed,
    write_carried,
    write_receipts,
    write_relayed,
)
from gr_ros2.wire.table import AnnouncedTopic, read_table, write_table
from tests.link.v1.air import KEY, Air, Robot, registry
from tests.wire import second_decoder as second

VECTORS: dict[str, Any] = json.loads((Path(__file__).parent.parent / "vectors" / "v1.json").read_text())


def named(kind: str) -> Any:
    return pytest.mark.parametrize("case", VECTORS[kind], ids=lambda case: case.get("name", case.get("hex", ""))[:40])


def refusals(ours: Callable[..., object], theirs: Callable[..., object], *arguments: Any) -> tuple[str, str]:
    """How the engine's decoder and the second one name what they refuse."""
    with pytest.raises(WireError) as one:
        ours(*arguments)
    with pytest.raises(second.Refused) as other:
        theirs(*arguments)
    return one.value.kind, str(other.value)


@named("packets")
def test_packets(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    packet = v1.decode(data, case["packet_len"], case["boot"], case["number"] >> 16)
    header = packet.header._asdict()
    block = header.pop("block")
    assert header == case["header"]
    assert v1.encode(packet, case["packet_len"], case["boot"], case["number"] >> 16, fixed=len(data) == 64) == data
    read = second.read_packet(data, case["packet_len"], case["boot"], case["newest"])
    assert read["entries"] == case["entries"]
    assert read["number"] == case["number"]
    assert read.get("repair_id") == case.get("repair_id")
    assert read.get("block") == case.get("block")
    said = json.loads(json.dumps(read_block(block)[0]._asdict())) if block else None
    assert said == case.get("block")


@named("bodies")
def test_bodies(case: dict[str, Any]) -> None:
    body, room = bytes.fromhex(case["hex"]), case["room"]
    assert second.read_body(body, room) == case["entries"]
    found = [entry for entry in v1.read_body(body, room) if isinstance(entry, v1.Part)]
    assert [{**part._asdict(), "payload": part.payload.hex()} for part in found] == case["entries"]
    if len(body) < room:  # as a repair brings it back
        assert second.read_body(body.ljust(room, b"\0"), room) == case["entries"]
        assert [part for part in v1.read_body(body.ljust(room, b"\0"), room) if isinstance(part, v1.Part)] == found


@named("refused_bodies")
def test_bodies_to_refuse(case: dict[str, Any]) -> None:
    body = bytes.fromhex(case["hex"])
    assert refusals(v1.read_body, second.read_body, body, case["room"]) == (case["error"], case["error"])


@named("relayed")
def test_messages_of_other_robots(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    ours = read_relayed(data)
    assert write_relayed(ours) == data
    fields = {name: value for name, value in case.items() if name != "hex"}
    after = None if ours.after is None else list(ours.after)
    assert {**ours._asdict(), "payload": ours.payload.hex(), "after": after} == second.read_relayed(data) == fields


@named("refused_relayed")
def test_messages_of_other_robots_to_refuse(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    assert refusals(read_relayed, second.read_relayed, data) == (case["error"], case["error"])


def test_ages_are_rounded_up_and_limits_down() -> None:
    cases = VECTORS["ages"]
    assert cases["codes"] == [pytest.approx(second.age_of(code)) for code in range(255)]
    assert cases["codes"] == [age_of(code) for code in range(255)]
    for age, code in cases["ages"]:
        assert age_code(age) == code == next((c for c in range(255) if second.age_of(c) >= age - 1e-9), 255)
    for age, code in cases["limits"]:
        assert limit_code(age) == code == max(c for c in range(255) if second.age_of(c) <= age + 1e-9)


@named("carried")
def test_carried_messages(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    taker, ours = read_carried(data)
    assert write_carried(taker, ours) == data
    fields = {name: value for name, value in case.items() if name != "hex"}
    ours_too = {"taker": taker, **ours._asdict(), "payload": ours.payload.hex()}
    assert ours_too == second.read_carried(data) == fields


@named("refused_carried")
def test_carried_messages_to_refuse(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    assert refusals(read_carried, second.read_carried, data) == (case["error"], case["error"])


@named("receipts")
def test_receipts(case: dict[str, Any]) -> None:
    data = bytes.fromhex(case["hex"])
    ours = read_receipts(data)
    assert write_receipts(ours) == data
    assert [receipt._asdict() for receipt in ours] == second.read_receipts(data) == case["receipts"]
    assert refusals(read_receipts, second.read_receipts, data + b"\0") == ("entry_bounds", "entry_bounds")


def test_kept_messages() -> None:
    received, wanted = ([bytes.fromhex(text) for text in VECTORS["kept"][name]] for name in ("received", "delivered"))
    assert second.delivered(received) == wanted
    outcomes = Outcomes()
    inbox = Inbox(
        1,
        1,
        1,
        40,
        Settings(2, packet_len=64),
        decoder_for=None,
        marks={},
        outcomes=outcomes,
        control=lambda _: None,
    )
    inbox.announced.take(write_table((AnnouncedTopic(0, "map", "std_msgs/msg/String", latched=True),)), (0, 0))
    for number, payload in enumerate(received, 1):
        part = v1.Part(0, payload)
        inbox.source(number, v1.write_body([part], 40), [part], 0, 0.0)
    assert [event.payload for event in outcomes.take() if isinstance(event, Delivered)] == wanted


def test_a_hello_that_is_not_first_in_the_clear_and_a_message_in_a_control_packet_have_no_effect() -> None:
    one, two = Robot(1, registry()), Robot(2)
    boot = VECTORS["packets"][0]["boot"]
    one.start(boot)
    Air(one, two).run(1.0)
    known = two.end.neighbours.all.get(1)
    assert known is not None
    before = (known.boot, known.hello, len(two.delivered()))
    cases = {case["name"]: bytes.fromhex(case["hex"]) for case in VECTORS["packets"]}
    two.receive(cases["a message in a control packet, which has no effect there"], 1.1)
    assert (known.boot, known.hello, len(two.delivered())) == before
    two.receive(cases["a hello of another start in a source packet, which has no effect there"], 1.1)
    assert two.end.neighbours.all.get(1) is known and 6 in known.inbox.decoder
    assert (known.boot, known.hello) == before[:2]
    assert two.end.received.rejected.total() == 0


def test_a_hello_of_its_own_start_behind_a_message_is_how_a_robot_is_met() -> None:
    two = Robot(2)
    (case,) = [case for case in VECTORS["packets"] if "by which the robot is met" in case["name"]]
    two.receive(bytes.fromhex(case["hex"]), 1.0)
    assert two.end.neighbours.all[1].boot == case["boot"]
    assert case["number"] in two.end.neighbours.all[1].inbox.decoder


def test_coefficients() -> None:
    for case in VECTORS["coefficients"]:
        repair_id, number = case["repair_id"], case["number"]
        assert coefficient(repair_id, number) == second.coefficient(repair_id, number) == case["coefficient"]


@named("repairs")
def test_repairs(case: dict[str, Any]) -> None:
    room = v1.body_room(case["packet_len"])
    here = {int(number): bytes.fromhex(body) for number, body in case["here"].items()}
    missing = {int(number): bytes.fromhex(body).ljust(room, b"\0") for number, body in case["missing"].items()}
    decoder = RepairDecoder(room, lambda _: True, 4096)
    decoder.begin(min(here | missing))
    found = {}
    for number, body in here.items():
        decoder.source(number, body)
    equations = []
    for text in case["repairs"]:
        data = bytes.fromhex(text)
        packet = v1.decode(data, case["packet_len"], case["boot"], case["newest"] >> 16)
        assert packet.repair is not None
        repair = packet.repair
        found.update(decoder.repair(case["newest"], repair.mask, repair.repair_id, packet.combined))
        read = second.read_packet(data, case["packet_len"], case["boot"], case["newest"])
        assert read["members"] == case["members"]
        members, body = read["members"], read["body"]
        assert isinstance(members, list)
        assert isinstance(body, bytes)
        equations.append((repair.repair_id, members, body))
    assert found == missing
    if len(missing) < 20:  # the second decoder takes its time
        assert second.solve(here, equations, room) == missing
    else:
        short = [(repair_id, members, body[:3]) for repair_id, members, body in equations]
        assert second.solve({}, short, 3) == {number: body[:3] for number, body in missing.items()}


@named("sealed")
def test_sealed_packets(case: dict[str, Any]) -> None:
    data, key = bytes.fromhex(case["hex"]), bytes.fromhex(case["key"])
    assert subkey(key, 1, case["boot"]).hex() == second.subkey(key, 1, case["boot"]).hex() == case["subkey"]
    read = second.read_packet(
        data, case["packet_len"], case["boot"], case["newest"], key=key, encrypts=case["encrypts"]
    )
    assert read["entries"] == case["entries"]
    mode: SealMode = "encrypt" if case["encrypts"] else "authenticate"
    header = v1.read_header(data, 64)
    start, repair_id, plain = header.size, NOT_A_REPAIR, False
    if header.qos == v1.QOS_REPAIR:
        repair = v1.read_repair_header(data, start, len(data) - 8)
        start, repair_id, plain = start + repair.size, repair.repair_id, repair.clear
    trailer = Keys((key,), mode).own(1, case["boot"])
    body = trailer.open(data[:start], data[start:], case["number"], repair_id, plain=plain)
    assert trailer.close(data[:start], body, case["number"], repair_id, plain=plain) == data
    for wrong in (case["newest"] + 65_536, case["newest"]):
        with pytest.raises(second.Refused, match="tag"):
            damaged = data[:-1] + bytes((data[-1] ^ 1,)) if wrong == case["newest"] else data
            second.read_packet(damaged, 64, case["boot"], wrong, key=key, encrypts=case["encrypts"])


def test_the_vectors_are_what_their_tool_writes() -> None:
    tool = Path(__file__).parents[2] / "tools" / "write-v1-vectors"
    space = run_path(str(tool))
    assert json.loads(json.dumps(space["vectors"]())) == VECTORS


def test_tables() -> None:
    for case in VECTORS["tables"]:
        data = bytes.fromhex(case["hex"])
        assert read_table(data) == tuple(AnnouncedTopic(**row) for row in case["rows"])
        assert second.read_table(data) == case["rows"]


def test_wishes() -> None:
    case = VECTORS["wishes"]
    for number, asked in enumerate(case["requests"], 1):
        frame = second.read_call(bytes.fromhex(asked["hex"]))
        assert (frame["robot"], frame["number"], frame["service"], frame["deadline"]) == (2, number, 240, 30.0)
        told = {key: value for key, value in asked.items() if key != "hex"}
        assert second.read_wish(cast("bytes", frame["payload"])) == told
        assert read_request(cast("bytes", frame["payload"]))
    for answer in case["answers"]:
        payload = cast("bytes", second.read_call(bytes.fromhex(answer["hex"]))["payload"])
        assert second.read_wish_answer(payload) == {key: value for key, value in answer.items() if key != "hex"}
        assert read_answer(payload).outcome == answer["outcome"]
    offers = bytes.fromhex(case["offers"]["hex"])
    assert second.read_offers(offers) == [asdict(row) for row in read_offers(offers)] == case["offers"]["rows"]
    for text in case["refused"]:
        with pytest.raises(ValueError):
            second.read_wish(bytes.fromhex(text))
        with pytest.raises(WireError):
            read_request(bytes.fromhex(text))


def test_rows_add_up_to_a_table() -> None:
    case = VECTORS["announced"]
    messages = [bytes.fromhex(text) for text in case["messages"]]
    known = AnnouncedTopics(None, 10_000)
    for number, message in enumerate(messages):
        known.take(message, (number, 0))
    assert known.take(messages[0], (0, 0)) is None, "an older row"
    assert [row._asdict() for row in known.topics.values()] == case["rows"]
    rows, digest = second.known_rows(messages)
    assert [row for row in rows.values() if row["name"]] == case["rows"]
    assert known.digest == digest == case["digest"]


def test_fragments_of_a_message_that_is_sent_again_add_up() -> None:
    case = VECTORS["sent_again"]
    bodies = {int(number): bytes.fromhex(body) for number, body in case["bodies"].items()}
    topic_id, message = case["topic_id"], bytes.fromhex(case["message"])
    assert second.messages(bodies, case["room"]) == {(topic_id, 5, 0): message}
    assert second.messages({n: body for n, body in bodies.items() if n != 23}, case["room"]) == {}
    reassembly, found = Reassembly(4096), []
    for number, body in bodies.items():
        (part,) = v1.read_body(body, case["room"])
        assert isinstance(part, v1.Part)
        found.append(reassembly.add(part, number, 0, repaired=False, now=0.0))
    assert [whole and whole.payload() for whole in found] == [None] * 4 + [message]


@pytest.mark.parametrize("mode", ["none", "authenticate", "encrypt"])
def test_the_second_decoder_understands_a_whole_link(mode: SealMode) -> None:
    """Half of the packets are lost; what repairs bring back is what the engine delivers, and nothing else."""
    one, two = Robot(1, registry(), mode=mode, hears=False), Robot(2, mode=mode, hears=False)
    rng = random.Random(9)
    room = v1.body_room(64, sealed=mode != "none")
    bodies: dict[int, bytes] = {}
    equations: list[tuple[int, list[int], bytes]] = []
    now, newest = 0.0, 0
    for index in range(160):
        now += 1 / 75
        if index % 8 == 0 and index < 120:
            one.end.messages.submit(index % 3, rng.randbytes(rng.choice((20, 130))), now)
        data = one.slot(now)
        if data is None or (rng.random() < 0.4 and index > 20):
            continue
        two.receive(data, now)
        read = second.read_packet(data, 64, one.boot, newest, key=KEY, encrypts=mode == "encrypt")
        newest = max(newest, int(str(read["number"])))
        body = read["body"]
        assert isinstance(body, bytes)
        if read["qos"] != 3:
            bodies[int(str(read["number"]))] = body.ljust(room, b"\0")[:room]
        elif read["members"]:
            members = read["members"]
            assert isinstance(members, list)
            equations.append((int(str(read["repair_id"])), members, body))
    assert equations
    bodies |= second.solve(bodies, equations, room)
    whole = second.messages(bodies, room)
    delivered = {
        (event.topic_id, event.key.number, event.key.place): event.payload
        for event in two.events
        if isinstance(event, Delivered)
    }
    assert len(delivered) >= 10
    assert delivered.items() <= whole.items()
