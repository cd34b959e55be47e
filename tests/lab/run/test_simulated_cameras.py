"""A camera in simulated time: its pictures cross as video, every message has a row, and runs repeat to the digit."""

from __future__ import annotations

from gr_ros2.codecs.messages import IMAGE, read
from gr_ros2.link import Delivered
from gr_ros2.settings.registry import Registry
from gr_ros2_lab.run.load import make_phy
from gr_ros2_lab.run.scenario import load_scenario
from gr_ros2_lab.run.simulate import Offered, Simulated, Simulation, simulate
from tests.codecs import scenes

ROWS = Registry.from_rows({"camera/image": IMAGE, "odom": "nav_msgs/Odometry"})
SET = ("topics=auto", "phy={name: psk, sample_rate: 256e3}", "channel.packet_loss=0.05")


def messages() -> list[Offered]:
    pictures = [
        Offered(number / 10, 0, scenes.image(scenes.view(number, 160, 120), "rgb8", number)) for number in range(30)
    ]
    return sorted([*pictures, *(Offered(n / 20, 1, b"\0\1\0\0" + bytes(720)) for n in range(60))], key=lambda m: m.t)


def run() -> Simulated:
    scenario = load_scenario("six-topics-paced", SET, duration_s=3.0)
    return simulate(scenario, registry=ROWS, messages=[iter(messages())])


def test_pictures_cross_and_the_run_repeats() -> None:
    one, other = run(), run()
    camera = one.topics[0]
    assert camera.sent == 30
    assert sum(camera.ledger.values()) == camera.sent
    assert camera.ledger["delivered"] + camera.ledger.get("repaired", 0) > 20
    assert [topic.ledger for topic in one.topics] == [topic.ledger for topic in other.topics]
    assert one.packets == other.packets


def test_what_is_shown_are_pictures() -> None:
    scenario = load_scenario("six-topics-paced", SET, duration_s=3.0)
    found = Simulation(scenario, ROWS, make_phy(scenario, ROWS), messages=[iter(messages())])
    shown = [event for _, _, event in found.events() if isinstance(event, Delivered) and event.topic_id == 0]
    assert len(shown) > 20
    assert {read(IMAGE, event.message).encoding for event in shown} == {"rgb8"}


def test_in_slots_a_camera_takes_the_air_that_is_free_and_makes_nobody_much_older() -> None:
    """Scenario ``cameras``, beside the same robots without the camera. With as many slots as the others it would have
    25 kbit/s."""

    def ages(rate: float) -> tuple[dict[str, float], Simulated]:
        scenario = load_scenario("cameras", (f"sim.camera_rate={rate}",), duration_s=12.0)
        found = simulate(scenario)
        odometry = [topic for topic in found.topics if topic.topic.endswith("/odom")]
        return {topic.topic: topic.age_s.mean for topic in odometry if topic.age_s.mean is not None}, found

    beside, found = ages(10)
    alone, _ = ages(0)
    assert len(alone) == 4
    for topic, age in beside.items():
        assert age < 1.5 * alone[topic], topic
    (frames,) = [made for made in found.frames.values() if made["frames"]]
    assert frames["frames"] > 100
    assert 8e-3 * frames["bytes"] / found.duration_s > 45
