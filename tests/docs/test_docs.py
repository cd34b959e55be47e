"""The documentation does what it says: every YAML loads, every command runs, every link leads somewhere."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from gr_ros2.cli import main as command_line
from gr_ros2.cli.console import console
from gr_ros2.cli.dashboard import audience
from gr_ros2.cli.link import _answers
from gr_ros2.cli.main import LazyGroup, cli
from gr_ros2.middleware import Qos
from gr_ros2.radio.config import link_from
from gr_ros2_lab.medium.process import load_medium
from gr_ros2_lab.run.scenario import load_scenario, scenario_from
from gr_ros2_lab.study.sweep.definition import load_sweep
from tests.docs.pages import PAGES, ROOT, Block, blocks, commands
from tests.once import once
from tests.programs import run_program
from tests.radio.calling_robots import Robots
from tests.radio.sound_server import sound_server_or_skip
from tests.waiting import PATIENCE_S, wait_for

LINK: dict[str, Any] = {
    "robot": "/robot_1",
    "registry": "table4",
    "phy": {"name": "psk", "sample_rate": 1e6},
    "front_end": {"name": "sim"},
}
SCENARIO: dict[str, Any] = {
    "name": "trial",
    "registry": str(ROOT / "gr_ros2/registries/odom.csv"),
    "robots": 2,
}
SWEEP: dict[str, Any] = {
    "scenario": "paper-ofdm-paced",
    "time": "samples",
    "grid": {"channel.snr_db": [8, 10], "packet_len": [64, 128]},
    "list": [{"phy.name": "ofdm", "phy.options": {}}, {"phy.name": "gfsk", "phy.options": {}}],
}

OTHERS = {"rviz2", "export", "direwolf", "cd", "git", "python3", "colcon", "ros2", "tshark", "dask", "."}
"""Programs that are not ours."""
ONLY_PARSED = {
    (
        "docs/how-to/sound.md",
        "gr-ros2 link --robot 1 --radio voice --transmit --set key=fleet.key --set front_end.ptt=rts --set "
        "front_end.ptt_device=/dev/ttyUSB0",
    ): "needs a serial line; tests/radio/test_ptt.py",
    ("docs/how-to/radios.md", "gr-ros2 link robot.yaml"): "needs a USRP",
    ("docs/how-to/radios.md", "gr-ros2 link robot.yaml --check"): "the same; tests/cli/test_status.py",
    (
        "docs/how-to/measured-channels.md",
        "gr-ros2 survey survey.csv --pose odom --base 3.5,-2",
    ): "needs a robot that drives; tests/cli/test_survey.py",
    **{
        ("docs/how-to/radios.md", f"gr-ros2 {words}"): "needs a running link; tests/cli/test_status.py"
        for words in (
            "status",
            "peers",
            "top",
            "ping 2",
            "ping 2 robot.yaml",
            "set topics.goal.to=7",
        )
    },
    **{
        ("docs/how-to/radios.md", f"gr-ros2 spectrum{config}"): "needs a USRP; tests/cli/test_spectrum.py"
        for config in ("", " robot.yaml")
    },
    ("docs/how-to/radios.md", "gr-ros2 throughput 2"): "needs two running links; tests/e2e/test_throughput.py",
    **{
        ("docs/how-to/radios.md", f"gr-ros2 link --robot {own} --radio zmq --listen 5551 --peer 10.0.0.{other}:5551"): (
            "opens a port to the network; tests/cli/test_link.py"
        )
        for own, other in ((1, 2), (2, 1))
    },
    **{
        (
            "docs/how-to/two-laptops.md",
            f"gr-ros2 link --robot {own} --radio zmq --listen 5551 --peer 10.0.0.{other}:5551{more}",
        ): ("opens a port to the network; tests/e2e/test_link_netns.py")
        for own, other, more in (
            (1, 2, ""),
            (2, 1, ""),
            (1, 2, " --set graph.namespace=/ --topics odom scan /tf /tf_static"),
        )
    },
    (
        "docs/how-to/two-laptops.md",
        "gr-ros2 dashboard",
    ): "needs a link in another terminal; tests/cli/test_dashboard.py",
    ("docs/how-to/dashboard.md", "gr-ros2 dashboard"): "needs a run in another terminal; tests/cli/test_dashboard.py",
    ("docs/how-to/dashboard.md", "gr-ros2 dashboard --wait 60"): "the same",
    ("docs/how-to/dashboard.md", "gr-ros2 run demo --dashboard=0.0.0.0:5006"): "opens a port to the network",
    ("docs/how-to/sweeps.md", "gr-ros2 sweep mine.yaml --scheduler tcp://HOST:8786"): "needs a Dask cluster",
    ("docs/how-to/sweeps.md", "gr-ros2 sweep mine.yaml --set duration_s=5 --workers 1"): "the sweep above, shorter",
    (
        "docs/how-to/sweeps.md",
        "gr-ros2 sweep pdr-vs-snr",
    ): "takes minutes; tests/lab/study runs its cells",
    ("docs/how-to/sweeps.md", "gr-ros2 sweep rate-vs-snr"): "the same",
    (
        "docs/how-to/teams.md",
        "gr-ros2 sweep formation",
    ): "takes minutes; tests/lab/study runs its cells",
    ("docs/how-to/teams.md", "gr-ros2 sweep rendezvous"): "the same",
    ("docs/how-to/experiments.md", "gr-ros2 plan my_link.yaml --graph"): "needs a robot; tests/lab/cli/test_plan.py",
    ("docs/how-to/experiments.md", "gr-ros2 ablate paper-ofdm-paced"): "takes minutes; tests/lab/cli/test_ablate.py",
    **{
        (
            "docs/how-to/packet-radios.md",
            f"gr-ros2 link --robot 1 --radio {radio} --device /dev/ttyUSB0 --transmit --open",
        ): ("no such device; tests/radio/test_packet_radios.py")
        for radio in ("sik", "lora-uart", "kiss")
    },
    ("docs/tutorial.md", "gr-ros2 registry from-graph --namespace /robot_1 --out topics.csv"): "needs a robot",
    ("docs/tutorial.md", "gr-ros2 registry check topics.csv"): "the same",
    (
        "docs/how-to/radios.md",
        "gr-ros2 link --robot 1 --radio kiss --device tcp://localhost:8001 --transmit --open "
        "--set front_end.callsign=N0CALL-1",
    ): "direwolf is not running",
    (
        "docs/how-to/radios.md",
        "gr-ros2 link --robot 1 --radio serial --device /dev/ttyUSB0 --transmit --open "
        "--set phy.options.bit_rate=64000",
    ): "no such device",
}
"""Commands that a test cannot run as they stand: why. They are parsed like the others."""
SHORTER = {
    "run": ("--duration", "1"),
    "demo": ("--duration", "1"),
    "link": ("--duration", "1"),
    "medium": ("--duration", "1"),
    "plan": ("--duration", "2"),
    "replay": ("--duration", "1"),
    "losses": ("--packets", "20"),
    "sweep": ("--set", "duration_s=0.5", "--workers", "1"),
}
"""What is added to a command so that it ends soon."""
REPORTING = "README.md"
"""The page whose runs write and draw their reports too. The others' do without: drawing takes longer than the run."""
WALKED = {
    "docs/four-robots.md": ("demo", "run"),
    "docs/tutorial.md": ("run", "compare", "registry", "replay"),
}
"""Commands that test_four_robots.py and test_tutorial.py run as they stand."""
APART = ("medium", "sweep")
"""Commands that run in a process of their own here, as all do where a person types them."""


def merged(base: Mapping[str, Any], keys: list[str], values: Any) -> dict[str, Any]:
    """A document with settings put in at a place."""
    result = dict(base)
    if not keys:
        return {**result, **values}
    inner = result.get(keys[0], {})
    result[keys[0]] = merged(inner, keys[1:], values)
    return result


@pytest.mark.parametrize("block", list(blocks("yaml")), ids=str)
def test_every_yaml_is_accepted(block: Block, tmp_path: Path) -> None:
    place, _, name = block.about.partition("=")
    assert place in ("file", "part-of"), f"{block}: say `yaml file=NAME` or `yaml part-of=KIND.KEY`"
    if place == "part-of":
        kind, *keys = name.split(".")
        values = yaml.safe_load(block.text)
        if kind == "sweep":
            path = tmp_path / "sweep.yaml"
            path.write_text(yaml.safe_dump(merged(SWEEP, keys, values)))
            assert load_sweep(path)
        elif kind == "link":
            assert link_from(merged(LINK, keys, values))
        else:
            assert kind == "scenario"
            assert scenario_from(
                {**merged(SCENARIO, keys, values), "registry": str(ROOT / "gr_ros2/registries/odom.csv")}
            )
        return
    path = tmp_path / name
    path.write_text(block.text)
    values = yaml.safe_load(block.text)
    if "front_end" in values or "radios" in values:
        assert link_from({"name": "trial", **values})
    elif "scenario" in values:
        assert load_sweep(path)
    elif any("bind" in robot for robot in values.get("robots", ()) if isinstance(robot, dict)):
        assert load_medium(path)
    else:
        assert load_scenario(path)


def every_command() -> list[Any]:
    return [
        pytest.param(block, words, id=f"{block}: {' '.join(words)[:60]}")
        for block in blocks("sh")
        for words in commands(block)
    ]


@pytest.mark.parametrize(("block", "words"), every_command())
def test_every_command_is_one(block: Block, words: list[str]) -> None:
    if words[0] == "sudo":
        words = words[1:]
    if words[0] == "make":
        targets = re.findall(r"^(\w[\w-]*):", (ROOT / "Makefile").read_text(), re.M)
        assert [word for word in words[1:] if "=" not in word and word not in targets] == []
        return
    if words[0] != "gr-ros2":
        assert words[0] in OTHERS or (ROOT / words[0]).is_file(), f"{block}: what is {words[0]}?"
        return
    command: click.Command = cli
    context = click.Context(cli, info_name="gr-ros2")
    rest = words[1:]
    while isinstance(command, LazyGroup):
        _, found, rest = click.Group.resolve_command(command, context, rest)
        assert found is not None
        command = found
    command.make_parser(context).parse_args(list(rest))  # an unknown option, or one without its value, raises


def runnable() -> list[Any]:
    """The commands that a test can run, each once."""
    found = {}
    for param in every_command():
        block, words = param.values
        if words[0] == "gr-ros2" and (block.page, " ".join(words)) not in ONLY_PARSED:
            own = (
                block.page
                if any(other.page == block.page and "file=" in other.about for other in blocks("yaml"))
                else ""
            )
            if words[1] not in WALKED.get(block.page, ()):
                found.setdefault((own, *words), param)
    return list(found.values())


@pytest.fixture(scope="module")
def sample_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the names that pages use exist: recordings, runs, scenarios."""
    return once(tmp_path_factory, "sample-runs", fill)


@pytest.fixture
def loudspeaker(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A sound server whose microphone hears its loudspeaker, and the key of a fleet."""
    if not (folder / "fleet.key").exists():
        command_line.run(["key", "new", str(folder / "fleet.key")])
    server = sound_server_or_skip(tmp_path)
    for name, value in {**server.env, "PULSE_SINK": "a", "PULSE_SOURCE": "a.monitor"}.items():
        monkeypatch.setenv(name, value)
    yield
    server.stop()


@pytest.fixture
def one_of_two_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A link that hears robot 2, which offers a topic, and that commands find."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    robots = Robots(tmp_path, "", offer=["auto"])
    with robots.stack, audience(None, console(), "robot 1", answers=_answers(robots.links[1])):
        robots.graphs[1].advertise("/robot_2/scan", "sensor_msgs/msg/LaserScan", Qos("reliable", "volatile", 1))
        wait_for(lambda: robots.links[2].source.found.offers, "the topic to be offered")
        wait_for(lambda: robots.links[1].stats()["peers"], "robot 2 to be heard")
        yield


def fill(folder: Path) -> None:
    demo = ("run", "demo", "--duration", "2", "--no-report", "--set", "time=packets")
    here(*demo, "--out", "clean", folder=folder)
    for name in ("noisy", "results/a", "results/b"):
        shutil.copytree(folder / "clean", folder / name)
    bag = folder / "clean" / "delivered"
    (mcap,) = bag.glob("*.mcap")
    for name in ("IN.mcap", "arrived.mcap"):
        shutil.copy(mcap, folder / name)
    here(*demo, "--out", "robot", "--set", "publish.as=/robot_{robot}", folder=folder)
    shutil.copytree(folder / "robot" / "delivered", folder / "my_bag")
    shutil.copy(ROOT / "gr_ros2_lab/scenarios/demo.yaml", folder / "my_scenario.yaml")
    shutil.copy(ROOT / "gr_ros2/examples/link-sim.yaml", folder / "my_link.yaml")
    shutil.copy(ROOT / "gr_ros2/registries/table4.csv", folder / "table4.csv")
    rows = [f"{t},{0.5 if 3 < t < 6 else 0}" for t in range(10)]
    (folder / "drive.csv").write_text("\n".join(["t_s,loss", *rows]))
    places = [f"{x},0,0,0,{60 - x},{x},{50 - x / 2}" for x in range(1, 40)]
    (folder / "survey.csv").write_text("\n".join(["x_m,y_m,their_x_m,their_y_m,packets,lost,snr_db", *places]))
    for path in (ROOT / "gr_ros2/examples").glob("link-*.yaml"):
        shutil.copy(path, folder)


def here(*arguments: str, folder: Path) -> str:
    """Run a command in a folder as `ours` does, but in this process, which has everything imported.

    :return: what it prints
    """
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        status = command_line.run([*arguments])
    assert status == 0, f"{' '.join(arguments)}: see above"
    return said.getvalue()


def ours(*arguments: str, folder: Path, home: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the program in a folder, with a home folder of its own; what it measures is kept for the next command."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **({} if home is None else {"HOME": str(home)})}
    environment["XDG_CACHE_HOME"] = str((home or folder).parent / "cache")
    environment["XDG_STATE_HOME"] = str((home or folder).parent / "state")  # a link of this process may hold its own
    command = [sys.executable, "-m", "gr_ros2.cli", *arguments]
    done = run_program(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, f"{' '.join(arguments)}: {done.stderr}"
    return done


@pytest.fixture
def folder(sample_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a reader types a command: with the sample runs, and a home folder of its own above."""
    shutil.copytree(sample_runs, tmp_path / "page")
    monkeypatch.chdir(tmp_path / "page")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "page"


@pytest.mark.parametrize(("block", "words"), runnable())
def test_every_command_runs(
    block: Block, words: list[str], folder: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    if block.page != REPORTING:
        request.getfixturevalue("undrawn")
    if block.page == "docs/how-to/sound.md":
        request.getfixturevalue("loudspeaker")
    if block.page == "docs/how-to/asked-from-afar.md":
        request.getfixturevalue("one_of_two_robots")
    for other in blocks("yaml"):
        place, _, name = other.about.partition("=")
        if other.page == block.page and place == "file":
            once_each = re.sub(r"^repetitions: \d+", "repetitions: 1", other.text, flags=re.M)
            (folder / name).write_text(once_each)
    if words[-2:-1] == ["--out"] or "--out" in words:
        shutil.rmtree(folder / words[words.index("--out") + 1], ignore_errors=True)
    if words[1] == "replay":
        (folder / words[3]).unlink(missing_ok=True)
    shorter = list(SHORTER.get(words[1], ()))  # of several settings of one name the last holds
    if words[1] in ("run", "demo") and not {"--pcap", "--dashboard", "time"} & {
        re.split("=", word)[0] for word in words
    }:
        shorter += ["--set", "time=packets"]
    if words[1] in ("run", "demo") and block.page != REPORTING:
        shorter += ["--no-report"]
    if "--dashboard" in words:
        words = [word if word != "--dashboard" else "--dashboard=0" for word in words]
    if {"--set", "front_end={name: file, read: sent}"} <= set(words):
        here("link", "link-file.yaml", *SHORTER["link"], folder=folder)
    if "--repetitions" in words:
        shorter += ["--repetitions", "2"]
    if words[1] in APART:
        said = ours(*words[1:], *shorter, folder=folder, home=folder.parent).stdout
    else:
        status = command_line.run([*words[1:], *shorter])
        said, complaint = capsys.readouterr()
        assert status == 0, f"{' '.join(words)}: {complaint}"
    assert said or words[1] in ("replay",), f"{block}: it says nothing"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(#[^)\s]*)?\)", page.read_text(encoding="utf-8")):
        path = (page.parent / target) if target else page
        assert path.exists(), f"{page.name}: {target} is missing"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.M)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor[1:] in slugs, f"{page.name}: {target}{anchor} is missing"


def test_every_page_is_listed() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in PAGES if ROOT / "docs" in page.parents}
    assert pages - {"README.md"} <= set(re.findall(r"\]\(([^)]+)\)", index))


def test_pages_that_code_names_exist() -> None:
    named: dict[str, Path] = {}
    for folder in ("gr_ros2", "tools", "bench", "fuzz", "tests", "launch"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".yml", ".yaml", ".grc", ".lua", ".csv", ".html", "") and path.is_file():
                text = path.read_text(encoding="utf-8", errors="ignore")
                named |= dict.fromkeys(re.findall(r"\bdocs/[\w/-]+\.md", text), path)
    assert [f"{path}: {name}" for name, path in named.items() if not (ROOT / name).is_file()] == []


def test_files_that_pages_name_exist() -> None:
    kinds = "gr_ros2|gr_ros2_lab|tests|tools|bench|packaging|debian"
    types_of_messages = ("gr_ros2/calls/Frame", "gr_ros2/throughput/Filler", "gr_ros2/backfill/Message")
    named = {
        (page.name, name)
        for page in PAGES
        for name in re.findall(rf"`((?:{kinds})/[\w./-]+)`", page.read_text(encoding="utf-8"))
        if name not in types_of_messages
    }
    assert len(named) > 50
    assert [f"{page}: {name}" for page, name in sorted(named) if not (ROOT / name).exists()] == []


def test_the_way_to_a_running_link_has_no_words_of_ours() -> None:
    """Who knows ROS alone reads these two pages. A link is explained there, the other words mean what they do
    elsewhere."""
    known = {"link", "packet", "channel", "peer", "version"}
    glossary = (ROOT / "docs" / "reference" / "glossary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \|", glossary.split("## Words of gr-ros2")[1], re.MULTILINE)
    ours = {word.strip() for row in rows[1:] for word in row.split(",")} - known - {"---"}
    assert len(ours) > 20
    for page in ("README.md", "docs/how-to/two-laptops.md"):
        text = re.sub(r"\]\([^)]*\)", "]", (ROOT / page).read_text(encoding="utf-8"))
        assert {word for word in ours if re.search(rf"\b{re.escape(word)}s?\b", text, re.IGNORECASE)} == set(), page
