"""GRC: descriptions that pass its own check, say what the code says, and examples that compile and carry messages."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from gnuradio import gr
from gnuradio.grc.core.platform import Platform
from gnuradio.grc.core.schema_checker import BLOCK_SCHEME, Validator

from gr_ros2.core.errors import ConfigError, RadioError
from gr_ros2.gr import RosLink
from gr_ros2.gr.link_sending import LinkSendingBlock
from gr_ros2.gr.receiving import ReceivingBlock
from gr_ros2.gr.ros_link import make_link
from gr_ros2.grc.path import example, grc_path
from gr_ros2.middleware import MIDDLEWARE, Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.paper import RosSink, RosSource
from gr_ros2.paper.settings import PaperConfig
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.radio import Radio, make_radio
from gr_ros2.settings.fields import settings_of
from gr_ros2.settings.robot import BackfillConfig, GraphConfig, PublishConfig, RobotConfig
from tests.gr.probe import Probe
from tests.once import once
from tests.waiting import wait_for

DESCRIPTIONS = sorted(grc_path().glob("*.block.yml"))
EXAMPLES = sorted(example("topics.csv").parent.glob("*.grc"))
ON_THE_AIR = ("uhd_radio", "soapy_radio", "pluto_radio")
"""Examples that need a radio: compiled, not run."""
ONE_WAY = ("file_radio",)
"""Examples in which nothing comes out by itself."""
WITH_WINDOW = "first_link"
"""The example with a window and a robot of its own."""
CARRYING = [path for path in EXAMPLES if path.stem not in (*ON_THE_AIR, *ONE_WAY, WITH_WINDOW)]
PURE_NUMBERS = {
    "tnc_port",
    "bt",
    "carriers",
    "detection_threshold",
    "domain_id",
    "graph_domain_id",
    "dst_id",
    "max_sources",
    "pilots",
    "robot_id",
    "rolloff",
    "sps",
    "sync_word",
}
"""Numbers without a unit: identifiers, ratios, and counts of what their label says."""
BLOCKS = {"ros2_source": RosSource, "ros2_sink": RosSink}


def description(name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((grc_path() / f"{name}.block.yml").read_text())
    return loaded


@pytest.mark.parametrize("path", DESCRIPTIONS, ids=lambda path: path.name)
def test_it_passes_grcs_own_check(path: Path) -> None:
    loaded = yaml.safe_load(path.read_text())
    validator = Validator(BLOCK_SCHEME)
    validator.run(loaded)
    assert validator.messages == []
    assert path.name == f"{loaded['id']}.block.yml"
    assert loaded["category"] == "[ROS 2]"
    assert loaded["documentation"]


@pytest.mark.parametrize("name", list(BLOCKS))
def test_parameters_and_defaults_are_those_of_the_settings(name: str) -> None:
    parts = {"": RobotConfig, "graph_": GraphConfig, "publish_": PublishConfig}
    wanted = {f"{part}{one.name}": one.default for part, cls in parts.items() for one in settings_of(cls)}
    wanted |= {setting.name: setting.default for setting in settings_of(PaperConfig)}
    wanted |= {"robot": "/robot_1" if name == "ros2_source" else "auto", "topics": ("auto",)}
    for parameter in description(name)["parameters"]:
        default, key = parameter["default"], parameter["id"]
        text = parameter["dtype"] in ("string", "file_open", "file_save")
        assert (default if text else ast.literal_eval(default)) == wanted[key], key


@pytest.mark.parametrize("name", list(BLOCKS))
def test_every_parameter_is_handed_over_and_every_callback_exists(name: str) -> None:
    loaded = description(name)
    for parameter in loaded["parameters"]:
        assert f"{parameter['id']}=${{{parameter['id']}}}" in loaded["templates"]["make"]
    for callback in loaded["templates"]["callbacks"]:
        assert hasattr(BLOCKS[name], callback.split("(")[0])


def test_ros_link_has_the_settings_of_a_robot_and_hands_them_over() -> None:
    loaded = description("ros2_link")
    parts = {"graph": GraphConfig, "publish": PublishConfig, "backfill": BackfillConfig}
    wanted = {setting.name for setting in settings_of(RobotConfig)} - set(parts)
    wanted |= {f"{part}_{setting.name}" for part, cls in parts.items() for setting in settings_of(cls)}
    offered = [parameter["id"] for parameter in loaded["parameters"]]
    assert len(offered) == len(set(offered))
    assert set(offered) == wanted | {
        "half_duplex",
        "any_length",
        "medium",
        "airtime_limit",
        "airtime_s",
        "slot_guard_s",
    }
    values = {parameter["id"]: parameter["default"] for parameter in loaded["parameters"]}
    assert (values["robot"], values["topics"], values["repair"]) == ('"/robot_1"', '("auto",)', '"auto"')
    for name in offered:
        assert f"{name}=${{{name}}}" in loaded["templates"]["make"]
    assert len(loaded["templates"]["callbacks"]) > 5
    classes = {"": RosLink, "source": LinkSendingBlock, "sink": ReceivingBlock}
    for callback in loaded["templates"]["callbacks"]:
        half, _, setter = callback.split("(")[0].rpartition(".")
        assert hasattr(classes[half], setter)


def test_ros_link_is_made_of_its_settings_and_refuses_others() -> None:
    settings = {"graph_middleware": "memory", "robot": "/robot_3", "hold_s": 0.5, "repair": "idle"}
    link = make_link(registry=str(example("topics.csv")), half_duplex=True, any_length=True, **settings)
    try:
        assert (link.source.src_id, link.source.config.repair, link.sink.config.hold_s) == (3, "idle", 0.5)
        assert link.sink.config.robot_id == 3
        assert link.end.endpoint.settings.half_duplex
        assert link.end.endpoint.settings.any_length
        assert link.source.middleware is link.sink.middleware
    finally:
        link.close()
    with pytest.raises(ConfigError, match="unknown key hold; known are robot, "):
        make_link(**settings, hold=1)
    with pytest.raises(ConfigError, match=r"unknown key publish\.hold; known are as, "):
        make_link(**settings, publish_hold=1)
    with pytest.raises(ConfigError, match=r"hold_s = -1"):
        make_link(**{**settings, "hold_s": -1})


def test_options_of_topics_change_while_a_ros_link_runs() -> None:
    settings = {"graph_middleware": "memory", "robot": "/robot_3", "registry": str(example("topics.csv"))}
    link = make_link(**settings, topics={"auto": None})
    try:
        (name,) = {
            topic.name for topic in link.source.subscriptions.registry if topic.is_topic and "odom" in topic.name
        }
        link.set_topics({"auto": None, name: {"max_rate": 5}})
        assert link.source.config.topics[name].max_rate == 5
        with pytest.raises(ConfigError, match="codec cannot change while running"):
            link.set_topics({"auto": None, name: {"codec": "zstd"}})
    finally:
        link.close()


def test_the_paper_has_an_example_with_version_0_and_radios_have_ros_link() -> None:
    """ROS Source and ROS Sink speak version 0 by default, ROS Link version 1."""
    kinds = {path.stem: path.read_text() for path in EXAMPLES}
    assert "id: ros2_source\n" in kinds["direct_loopback"]
    assert "version: '1'" not in kinds["direct_loopback"]
    for name in (*ON_THE_AIR, "zmq_radios"):
        assert "id: ros2_link\n" in kinds[name]
        assert "id: ros2_source\n" not in kinds[name]


def test_the_blocks_are_as_their_settings_say() -> None:
    tool = Path(__file__).resolve().parents[2] / "tools" / "write-grc"
    done = subprocess.run([sys.executable, tool, "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", DESCRIPTIONS, ids=lambda path: path.stem)
def test_every_field_is_named_in_plain_words_with_its_unit_and_explained(path: Path) -> None:
    loaded = yaml.safe_load(path.read_text())
    labels = [parameter["label"] for parameter in loaded["parameters"]]
    assert len(set(labels)) == len(labels)
    explained = tuple(re.findall(r"^([^:\n]+): ", loaded["documentation"], re.MULTILINE))
    for parameter in loaded["parameters"]:
        words, _, unit = parameter["label"].partition(" (")
        assert words.startswith(explained), words
        number = parameter["dtype"] in ("int", "real") or parameter["default"] == "None"
        # A drop-down may need no unit: its choices speak for themselves.
        assert unit or not number or parameter["dtype"] == "enum" or parameter["id"] in PURE_NUMBERS, words


def test_the_manifest_says_what_cgran_reads() -> None:
    text = (Path(__file__).resolve().parents[2] / "MANIFEST.md").read_text()
    header, _, body = text.partition("\n---\n")
    loaded = yaml.safe_load(header)
    wanted = {"title", "brief", "tags", "author", "copyright_owner", "license", "gr_supported_version", "dependencies"}
    assert wanted <= set(loaded)
    assert loaded["gr_supported_version"] == "v3.10"  # a bare 3.10 is the number 3.1
    assert body.strip()


def test_a_setting_has_one_label_wherever_it_stands() -> None:
    labels: dict[str, set[str]] = {}
    for path in DESCRIPTIONS:
        for parameter in yaml.safe_load(path.read_text())["parameters"]:
            labels.setdefault(parameter["id"], set()).add(parameter["label"])
    assert {name: said for name, said in labels.items() if len(said) > 1} == {}


@pytest.mark.parametrize("name", list(FRONT_ENDS.own))
def test_a_radio_offers_what_it_can_do(name: str) -> None:
    loaded = description(f"ros2_radio_{name}")
    offered = {parameter["id"]: parameter["dtype"] for parameter in loaded["parameters"]}
    settings = {item.name for item in fields(FRONT_ENDS.load(name).Options)}
    refused = FRONT_ENDS.load(name).refuses
    channel = set() if FRONT_ENDS.load(name).has_radio else {"snr_db", "frequency_offset", "packet_loss"}
    sampled = set() if FRONT_ENDS.load(name).carries_packets else {"sample_rate", "record"}
    made = {"phy", "phy_options", "packet_len", "airtime_limit", "robot_id", "state"} | sampled
    made |= {"transmit", "open"} if FRONT_ENDS.load(name).has_radio else set()
    assert set(offered) == settings - refused | channel | made
    assert offered.get("record", "file_save") == "file_save"
    for setting in offered:
        assert f"{setting}=${{{setting}}}" in loaded["templates"]["make"]
    callbacks = loaded["templates"].get("callbacks", [])
    assert {callback.partition("(")[0] for callback in callbacks} == {f"set_{setting}" for setting in channel}
    assert all(hasattr(Radio, callback.partition("(")[0]) for callback in callbacks)


def test_what_a_radio_does_not_offer_it_refuses() -> None:
    for setting in ("antenna_tx", "antenna_rx"):
        with pytest.raises(RadioError, match="leave antennas out"):
            make_radio("psk", 220, 1e6, "pluto", frequency=433e6, transmit=True, **{setting: "A"})


def test_options_are_the_tables() -> None:
    for name in BLOCKS:
        options = {item["id"]: item.get("options") for item in description(name)["parameters"]}
        assert [ast.literal_eval(option) for option in options["graph_middleware"]] == [
            name for name, row in MIDDLEWARE.own.items() if row.scope != "none"
        ]


def make_platform() -> Platform:
    """GRC without a window, which knows our blocks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRC_BLOCKS_PATH", str(grc_path()))
        platform = Platform(
            name="test",
            prefs=gr.prefs(),
            version=gr.version(),
            version_parts=(gr.major_version(), gr.api_version(), gr.minor_version()),
        )
        platform.build_library()
    return platform


@pytest.fixture(scope="module")
def platform() -> Platform:
    return make_platform()


def test_grc_lists_the_blocks(platform: Platform) -> None:
    assert {path.name.removesuffix(".block.yml") for path in DESCRIPTIONS} <= set(platform.blocks)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_opens_without_a_complaint(platform: Platform, path: Path) -> None:
    graph = platform.make_flow_graph(str(path))
    graph.rewrite()
    graph.validate()
    assert [str(message) for message in graph.iter_error_messages()] == []


def complaints(platform: Platform, name: str, blocks: Iterable[str], setting: str, value: str) -> str:
    """What GRC says of an example with a setting of some blocks changed."""
    graph = platform.make_flow_graph(str(example(name)))
    for block in blocks:
        graph.get_block(block).params[setting].set_value(value)
    graph.rewrite()
    graph.validate()
    return " ".join(str(message) for message in graph.iter_error_messages())


@pytest.mark.parametrize(("setting", "value"), [("packet_len", "13"), ("graph_domain_id", "233")])
def test_grc_refuses_what_the_block_would_refuse(platform: Platform, setting: str, value: str) -> None:
    blocks = [f"{name}_0" for name in BLOCKS]
    said = complaints(platform, "direct_loopback.grc", blocks, setting, value)
    assert all(block in said for block in blocks)


@pytest.mark.parametrize(
    ("setting", "good", "bad"),
    [("snr_db", "None", "101"), ("snr_db", "-3", "'20'"), ("packet_loss", "0.5", "1.1"), ("guard_s", "0.001", "-1")],
)
def test_grc_knows_the_range_of_a_radios_settings(platform: Platform, setting: str, good: str, bad: str) -> None:
    assert not complaints(platform, "sim_radio.grc", ["radio"], setting, good)
    assert setting in complaints(platform, "sim_radio.grc", ["radio"], setting, bad)


def test_grc_offers_clock_sources_and_takes_others(platform: Platform) -> None:
    for source in ("auto", "external", "another"):
        assert not complaints(platform, "uhd_radio.grc", ["radio"], "clock_source", source)
    offered = next(item for item in description("ros2_radio_uhd")["parameters"] if item["id"] == "clock_source")
    assert {"auto", "internal", "external", "gpsdo"} <= set(offered["options"])


def compiled(platform: Platform, path: Path, folder: Path) -> ModuleType:
    """The program GRC makes of a flowgraph, imported. The command ``grcc`` does the same."""
    platform.load_and_generate_flow_graph(str(path), str(folder))
    spec = importlib.util.spec_from_file_location(path.stem, folder / f"{path.stem}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def in_memory(platform: Platform, path: Path, folder: Path) -> Any:
    """An example's flowgraph on the graph of tests, which needs no discovery time, and at addresses of its own."""
    copy = folder / path.name
    text = path.read_text().replace("'\"dds\"'", "'\"memory\"'")
    copy.write_text(text.replace("tcp://127.0.0.1:", f"ipc://{folder}/"))
    assert "memory" in copy.read_text()
    return getattr(compiled(platform, copy, folder), path.stem)()


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_THE_AIR)
def test_an_example_that_needs_a_radio_says_so_in_one_line(name: str, platform: Platform, tmp_path: Path) -> None:
    copy = tmp_path / f"{name}.grc"
    text = example(f"{name}.grc").read_text().replace("'\"dds\"'", "'\"memory\"'")
    front_end = name.removesuffix("_radio")
    for word, said in (
        ("'\"auto\"'", f"ConfigError: front_end {front_end} sends at "),
        ("'True'", f"RadioError: front_end {front_end}: args = "),
    ):
        copy.write_text(text.replace("transmit: '\"auto\"'", f"transmit: {word}"))
        program = Path(str(compiled(platform, copy, tmp_path).__file__))
        done = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
        assert done.returncode != 0
        assert said in done.stderr.splitlines()[-1]


@pytest.mark.slow
def test_the_noise_of_the_simulated_radio_can_be_changed_while_it_runs(platform: Platform, tmp_path: Path) -> None:
    top = in_memory(platform, example("sim_radio.grc"), tmp_path)
    heard: list[bytes] = []
    try:
        with MemoryMiddleware(domain_id=41) as robot, MemoryMiddleware(domain_id=42) as other:
            other.subscribe("/rx_robot_1/odom", "nav_msgs/Odometry", Qos(depth=0), heard.append)
            top.start()
            publisher = robot.advertise("/robot_1/odom", "nav_msgs/Odometry", Qos(depth=0))

            def send() -> None:
                publisher.publish(b"\0\1\0\0" + bytes(720))

            wait_for(lambda: send() or heard, "the first message")
            top.set_snr_db(3)  # as GRC's widgets call it; enough to be found, too little to be read
            wait_for(lambda: send() or top.radio.damaged > 20, "packets that are lost in noise")
            top.set_snr_db(None)
            heard.clear()
            wait_for(lambda: send() or heard, "a message without noise")
    finally:
        top.stop()
        top.wait()
        top.ros2_link_1.close()
        top.ros2_link_2.close()
        top.radio.close()


def test_what_the_file_example_records_is_received_again(
    platform: Platform, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    copy = tmp_path / "file_radio.grc"
    text = example("file_radio.grc").read_text().replace("'\"dds\"'", "'\"memory\"'")
    copy.write_text(text.replace("queue_depth: '100'", "queue_depth: '100'\n    repair: '\"off\"'"))
    top = compiled(platform, copy, tmp_path).file_radio()
    sent = [b"\0\1\0\0" + bytes([number]) * 720 for number in range(10)]
    try:
        with MemoryMiddleware(domain_id=41) as robot:
            top.start()
            publisher = robot.advertise("/robot_1/odom", "nav_msgs/Odometry", Qos(depth=0))
            for payload in sent:
                publisher.publish(payload)
            taken = lambda: top.ros2_source_0.stats()["topics"]["/robot_1/odom"]["submitted"]  # noqa: E731
            wait_for(lambda: taken() == len(sent), "every message")
            wait_for(lambda: top.ros2_source_0.idle and top.radio.counts().backlog == 0, "every packet to leave")
            packets = top.ros2_source_0.stats()["packets"]
            whole = packets * top.radio.phy.airtime_samples() * 8  # bytes; the transmitter is some samples ahead
            wait_for(lambda: Path("sent.sigmf-data").stat().st_size >= whole, "every sample")
    finally:
        top.stop()
        top.wait()
        top.ros2_source_0.close()
        top.radio.close()
    sink = Probe()
    again = gr.top_block()
    radio = make_radio("psk", top.packet_len, top.samp_rate, "file", read="sent", speed=0)
    again.msg_connect(radio, "pdus", sink, "pdus")
    again.start()
    try:
        wait_for(lambda: sink.handled >= packets, "every packet of the recording")
    finally:
        again.stop()
        again.wait()
        radio.close()


@pytest.mark.slow
@pytest.mark.parametrize("path", CARRYING, ids=lambda path: path.stem)
def test_an_example_compiles_and_carries_messages(path: Path, platform: Platform, tmp_path: Path) -> None:
    top = in_memory(platform, path, tmp_path)
    heard: list[bytes] = []
    try:
        with MemoryMiddleware(domain_id=41) as robot, MemoryMiddleware(domain_id=42) as other:
            other.subscribe("/rx_robot_1/odom", "nav_msgs/Odometry", Qos(depth=0), heard.append)
            top.start()
            publisher = robot.advertise("/robot_1/odom", "nav_msgs/Odometry", Qos(depth=0))
            # Radios of two programs find each other first; what is sent before is lost, as on the air. Until then a
            # message now and then is enough: more would fill the queue of a busy computer.
            first = b"\0\1\0\0" + bytes(720)
            wait_for(lambda: publisher.publish(first) or heard, "the first message", longest_s=0.5)
            sent = [b"\0\1\0\0" + bytes([number]) * 720 for number in range(1, 11)]
            for payload in sent:
                publisher.publish(payload)
                wait_for(lambda payload=payload: heard[-1:] == [payload], "a message")  # type: ignore[misc]
            assert heard[-len(sent) :] == sent, "every message, in order"
    finally:
        top.stop()
        top.wait()
        for name in ("ros2_source_0", "ros2_sink_0", "ros2_link_1", "ros2_link_2"):
            if hasattr(top, name):
                getattr(top, name).close()


@pytest.mark.slow
def test_the_first_example_shows_its_robots_topics_and_what_the_slider_does(tmp_path: Path) -> None:
    """In a process of its own: what is left of Qt's windows crashed the tests that came after it."""
    pytest.importorskip("PyQt5", reason="needs PyQt5, which comes with Debian's GNU Radio")
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "XDG_RUNTIME_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "tests.gr.first_window", str(example(f"{WITH_WINDOW}.grc")), str(tmp_path)]
    done = subprocess.run(command, env=environment, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def drawings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Name and rectangle of every block of every example, px, as GNU Radio Companion draws them; and of every wire the
    blocks at its ends, and the points of its two lines and of the Bezier curve between them."""
    pytest.importorskip("gi", reason="needs GTK; Debian: apt-get install gir1.2-gtk-3.0")
    if not shutil.which("xvfb-run"):
        pytest.skip("needs a screen; Debian: apt-get install xvfb")
    found: dict[str, Any] = json.loads((once(tmp_path_factory, "drawings", draw) / "drawings.json").read_text())
    return found


def draw(folder: Path) -> None:
    environ = {**os.environ, "GRC_BLOCKS_PATH": str(grc_path())}
    done = subprocess.run(
        ["xvfb-run", "-a", sys.executable, "-c", DRAW, *map(str, EXAMPLES)], env=environ, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (folder / "drawings.json").write_text(done.stdout.splitlines()[-1])


DRAW = """
import json, sys
import gi
gi.require_version("Gtk", "3.0"), gi.require_version("PangoCairo", "1.0")
from gi.repository import Gtk
from gnuradio import gr
from gnuradio.grc.gui.Platform import Platform
from gnuradio.grc.gui.canvas import flowgraph
flowgraph._ContextMenu = lambda window: None  # a menu needs the main window
platform = Platform(version=gr.version(), version_parts=(gr.major_version(), gr.api_version(), gr.minor_version()),
                    prefs=gr.prefs(), install_prefix=gr.prefix())
platform.build_library()
window = Gtk.OffscreenWindow()
area = Gtk.DrawingArea()
window.add(area)
window.show_all()
application = Gtk.Application()
application.register(None)
application.get_windows = lambda: []
Gtk.Application.set_default(application)
found = {}
for path in sys.argv[1:]:
    graph = platform.make_flow_graph(path)
    graph.drawing_area = area
    graph.update()
    graph.update_elements_to_draw()
    for block in graph.blocks:
        block.create_labels()
        block.create_shapes()
    blocks = [
        [block.name, [*block.coordinate, block.coordinate[0] + block.width, block.coordinate[1] + block.height]]
        for block in graph.blocks
    ]
    wires = []
    for wire in graph.connections:
        wire.create_shapes()
        start, end = wire.source_port.connector_coordinate_absolute, wire.sink_port.connector_coordinate_absolute
        places = [start, *([x + a, y + b] for (x, y), (a, b) in zip((start, start, end, end, end), wire._rel_points))]
        ends = [wire.source_block.name, wire.sink_block.name]
        wires.append([ends, places])
    found[path] = [blocks, wires]
print(json.dumps(found))
"""


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_no_block_of_an_example_is_drawn_over_another(path: Path, drawings: dict[str, Any]) -> None:
    blocks, _ = drawings[str(path)]
    assert len(blocks) > 3
    over = [
        f"{one} and {other}"
        for number, (one, a) in enumerate(blocks)
        for other, b in blocks[:number]
        if a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
    ]
    assert over == []


CANVAS = 1170, 550
"""Pixels that GRC's window of 1366 by 768 leaves for blocks beside its lists."""


@pytest.mark.slow
def test_the_first_example_fits_the_screen_of_a_laptop(drawings: dict[str, Any]) -> None:
    blocks, wires = drawings[str(example(f"{WITH_WINDOW}.grc"))]
    assert len(blocks) <= 10, "nine and the options"
    ends = [(right, bottom) for _, (_, _, right, bottom) in blocks] + [point for _, points in wires for point in points]
    assert all(x < CANVAS[0] and y < CANVAS[1] for x, y in ends), ends


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_wire_of_an_example_can_be_followed(path: Path, drawings: dict[str, Any]) -> None:
    blocks, wires = drawings[str(path)]
    assert wires
    under = {
        f"{' to '.join(ends)} under {name}"
        for ends, points in wires
        for name, (left, top, right, bottom) in blocks
        for x, y in _places(points)
        if left + 2 < x < right - 2 and top + 2 < y < bottom - 2
    }
    assert under == set()


Point = tuple[float, float]


def _places(wire: Sequence[Point]) -> Iterator[Point]:
    """Places along a wire: its ends, and the Bezier curve between two short lines."""
    start, *curve, end = wire
    yield from (start, end)
    for t in (step / 60 for step in range(61)):
        weights = ((1 - t) ** 3, 3 * (1 - t) ** 2 * t, 3 * (1 - t) * t**2, t**3)
        x, y = (sum(w * point[axis] for w, point in zip(weights, curve, strict=True)) for axis in (0, 1))
        yield x, y
