"""The worked examples of docs/how-to/extend.md: installed from the page as a package, and held to the contracts."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.packages import REPOSITORY, install, run

PAGE = (REPOSITORY / "docs/how-to/extend.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^### [^\n]*`(\w+)\.py`\n.*?^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
DIFFS = re.findall(r"^```diff\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
ASK = """
from gr_ros2.cli.params import setting_keys
from gr_ros2.settings.config import build
from gr_ros2.core.errors import ConfigError
from gr_ros2.radio.config import LinkConfig, link_from
from gr_ros2.ros.parameters import parameters
from gr_ros2.settings.robot import RobotConfig

try:
    build(RobotConfig, {"robot": 1, "warm_up_s": -1})
except ConfigError as error:
    print(error)
link = link_from({"robot": 1, "warm_up_s": 2.5, "phy": {"name": "direct"}})
print(*(f"{p.name} {p.value} {p.meaning} {p.minimum}" for p in parameters(link) if "warm_up_s" in p.name))
print("warm_up_s" in list(setting_keys(LinkConfig)))
"""
"""What the command line, YAML and ROS know of the example's setting."""
TOML = "".join(re.findall(r"^```toml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("site-packages")
    groups: dict[str, dict[str, str]] = {}
    for line in filter(None, TOML.splitlines()):
        if group := re.fullmatch(r'\[project\.entry-points\."(.*)"\]', line):
            rows = groups.setdefault(group[1], {})
        else:
            name, value = re.fullmatch(r'(\w+) = "(.*)"', line).groups()  # type: ignore[union-attr]
            rows[name] = value
    install(made, "worked-examples", FILES, groups)
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "suite", "least"),
    [
        ("spool", ("tests/middleware/test_contract.py",), 30),
        ("halfsine", ("tests/phy/test_contract.py", "tests/phy/test_loopback.py"), 15),
        ("scan", ("tests/codecs/test_contract.py",), 10),
    ],
)
def test_a_worked_example_keeps_the_contract(
    folder: Path, tmp_path: Path, name: str, suite: tuple[str, ...], least: int
) -> None:
    if name == "halfsine":
        pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    if name == "scan":
        pytest.importorskip("av", reason="needs PyAV: pip install 'gr-ros2[video]'")
    done = run(folder, "-m", "pytest", "-q", "-p", "no:cacheprovider", *suite, "-k", name, SPOOL=str(tmp_path))
    passed = re.search(r"(\d+) passed", done.stdout)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr
    assert passed is not None and int(passed[1]) >= least, done.stdout[-1000:]
    assert "skipped" not in done.stdout, done.stdout[-1000:]


@pytest.mark.slow
def test_the_worked_examples_carry_a_run_together(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    scenario = tmp_path / "worked.yaml"
    scenario.write_text(
        "{name: worked, registry: table4, duration_s: 2, packet_len: 64, phy: {name: halfsine, options: {sps: 8}}, "
        "graph: {middleware: spool}, robots: [{direction: send, graph: {domain_id: 41}}, "
        "{direction: receive, graph: {domain_id: 42}}]}"
    )
    arguments = ("run", str(scenario), "--no-report", "--out", str(tmp_path / "out"))
    done = run(folder, "-m", "gr_ros2.cli", *arguments, SPOOL=str(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    assert '"name": "halfsine"' in next((tmp_path / "out").glob("*.json")).read_text()


CODE_SCANS = """
from gr_ros2.compression.link_codec import WHOLE
from gr_ros2.gr.factory import message_codec
from gr_ros2.settings.registry import Topic
from tests.codecs.scenes import scan

topic = Topic(0, "scan", "sensor_msgs/msg/LaserScan")
message, codec = scan(), message_codec([topic])
coded = codec.encode(0, message)
print(coded[0] == WHOLE, message_codec([topic]).decode(0, coded) == message, len(coded) < 0.5 * len(message))
"""
"""What a link makes of a laser scan."""


def test_a_link_codes_with_the_codec_of_another_package(folder: Path) -> None:
    pytest.importorskip("av", reason="needs PyAV, for the scenes of other codecs")
    done = run(folder, "-c", CODE_SCANS)
    assert done.stdout.split() == ["True"] * 3, done.stderr


@pytest.mark.parametrize("name", sorted(FILES))
def test_the_worked_examples_are_written_like_the_rest(folder: Path, name: str) -> None:
    pytest.importorskip("ruff", reason="ruff is not installed")
    for check in (("check", "--config", "pyproject.toml"), ("format", "--check", "--config", "pyproject.toml")):
        done = run(folder, "-m", "ruff", *check, str(folder / f"{name}.py"))
        assert done.returncode == 0, done.stdout + done.stderr
    pytest.importorskip("mypy", reason="mypy is not installed")
    typed = run(folder, "-m", "mypy", "--config-file", "pyproject.toml", str(folder / f"{name}.py"))
    assert typed.returncode == 0, typed.stdout


def test_the_page_has_an_example_of_each() -> None:
    assert sorted(FILES) == ["halfsine", "scan", "spool"]
    assert len(DIFFS) == 1


@pytest.mark.slow
def test_a_setting_is_one_field(tmp_path: Path) -> None:
    """The example's lines, added to a copy of the tree, are everywhere once the tools have run."""
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    ignored = shutil.ignore_patterns("__pycache__", "scenarios", "losses", "examples")
    for folder in ("gr_ros2", "tools", "docs/reference"):
        shutil.copytree(REPOSITORY / folder, tmp_path / folder, ignore=ignored)
    config = tmp_path / "gr_ros2" / "settings" / "robot.py"
    text = config.read_text(encoding="utf-8")
    for diff in DIFFS:
        before, *added = (line[1:] for line in diff.splitlines())
        assert f"{before}\n" in text, before
        text = text.replace(f"{before}\n", "\n".join([before, *added, ""]))
    config.write_text(text, encoding="utf-8")
    for command in (["tools/write-parameters"], ["tools/write-grc"], ["-c", ASK]):
        done = subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "warm_up_s = -1: must be greater than or equal to 0",
        "warm_up_s 2.5 s after the start in which nothing is sent 0.0",
        "True",
    ]
    page = (tmp_path / "docs" / "reference" / "parameters.md").read_text(encoding="utf-8")
    bounds = "0..1 000 000 000".replace(" ", "\N{NARROW NO-BREAK SPACE}")
    assert page.count(f"| `warm_up_s` | `0`, {bounds} | s after the start in which nothing is sent |") == 1
    block = (tmp_path / "gr_ros2" / "grc" / "ros2_link.block.yml").read_text(encoding="utf-8")
    asserted, said = "${ 0 <= warm_up_s <= 1000000000.0 }", "Warm up: s after the start"
    for part in ("label: Warm up (s)", asserted, "warm_up_s=${warm_up_s}", said):
        assert part in block
