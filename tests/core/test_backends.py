"""The tables of back-ends: nothing is imported before it is chosen, and a missing package is named."""

from __future__ import annotations

import ast
import signal
import subprocess
import sys
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import gr_ros2
from gr_ros2.core.backends import Backend, BackendTable
from gr_ros2.core.errors import BackendMissingError, ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS

ROWS = {
    "there": Backend("collections", "OrderedDict", "always there"),
    "missing": Backend("no_such_package_at_all.bus", "Bus", "not installed", "pip install no-such-package"),
    "partly": Backend("collections", "Counter", "its settings are known", "pip install a-part", imports=("no_part",)),
    "broken": Backend("no_such_package_at_all.bus", "Bus", "ours, so a missing module is a bug"),
}
TABLE = BackendTable("bus", ROWS, Backend)


def test_a_table_is_a_mapping_in_order() -> None:
    assert list(TABLE) == list(ROWS)
    assert len(TABLE) == 4
    assert TABLE["missing"].requires == "pip install no-such-package"
    assert "nonsense" not in TABLE


def test_load_gives_the_class() -> None:
    assert TABLE.load("there") is OrderedDict


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="bus: no 'nonsense'; known are there, missing, partly, broken"):
        TABLE.load("nonsense")


def test_a_missing_back_end_names_the_package() -> None:
    with pytest.raises(BackendMissingError, match="bus 'missing' needs pip install no-such-package"):
        TABLE.load("missing")


def test_what_a_back_end_needs_only_when_it_is_used_is_named_too() -> None:
    assert TABLE.load("partly")
    with pytest.raises(BackendMissingError, match=r"bus 'partly' needs pip install a-part \(No module .*'no_part'"):
        TABLE.modules("partly")
    assert TABLE.modules("there") == ()


def test_a_missing_back_end_is_an_import_error_too() -> None:
    with pytest.raises(ImportError):
        TABLE.load("missing")


def test_a_bug_of_ours_does_not_look_like_a_missing_package() -> None:
    with pytest.raises(ModuleNotFoundError) as caught:
        TABLE.load("broken")
    assert not isinstance(caught.value, BackendMissingError)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("works", [True, False])
def test_a_signal_waits_for_the_end_of_an_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, works: bool, number: signal.Signals
) -> None:
    name = f"signalled_{works}_{number.name}".lower()
    lines = ["import signal", f"signal.raise_signal({int(number)})", "Bus = 1" if works else "import no_such_package"]
    (tmp_path / f"{name}.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    table = BackendTable("bus", {"one": Backend(name, "Bus", "is interrupted", "pip install something else")}, Backend)
    before = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            table.load("one")
        assert signal.getsignal(number) is signal.default_int_handler
        assert (name in sys.modules) is works
    finally:
        signal.signal(number, before)


def test_a_thread_loads_too() -> None:
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(TABLE.load, "there").result() is OrderedDict


@pytest.mark.parametrize("table", [MIDDLEWARE, PHY, FRONT_ENDS], ids=lambda table: table.family)
def test_every_row_has_a_summary_of_one_line(table: BackendTable[Backend]) -> None:
    assert table.own
    assert all(row.summary and "\n" not in row.summary for row in table.own.values())


NAMES = {*MIDDLEWARE.own, *PHY.own, *FRONT_ENDS.own}
MEANT = {
    "gr_ros2/cli/sound.py": {"audio"},
    "gr_ros2/doctor/radios.py": {"audio"},
    "gr_ros2/settings/config.py": {
        "sim",
        "direct",
    },  # the simulated robots; the one PHY of this package without airtime
    "gr_ros2_lab/report/snr_map.py": {"sim"},  # the simulated robots
    "gr_ros2/doctor/ros.py": {"rclpy", "zenoh"},  # the Python module, and a part of the name of an RMW
    "gr_ros2_lab/race/endpoints.py": {"dds", "zenoh"},  # these very stacks are what races
    "gr_ros2_lab/race/race_settings.py": {"zenoh"},
    "gr_ros2_lab/run/scenario.py": {"sim"},
}
"""Modules outside the back-ends' own that may name one, and which."""


def test_no_module_decides_by_the_name_of_a_back_end() -> None:
    """A row of another name would not be part of what is compared with a name, or opened by one."""
    root = Path(gr_ros2.__file__).parents[1]
    found: dict[str, set[str]] = {}
    for path in sorted(root.glob("gr_ros2*/**/*.py")):
        text = path.read_text("utf-8")
        for node in ast.walk(ast.parse(text if any(f'"{name}"' in text for name in NAMES) else "")):
            used: list[ast.AST] = []
            if isinstance(node, ast.Compare):
                used = [node.left, *node.comparators]
            elif isinstance(node, ast.Call):
                opens = {getattr(node.func, "attr", ""), getattr(node.func, "id", "")} & {"load", "join_graph"}
                used = list(node.args) if opens else []
            constants = (part for item in used for part in ast.walk(item) if isinstance(part, ast.Constant))
            found.setdefault(path.relative_to(root).as_posix(), set()).update(
                str(constant.value) for constant in constants if constant.value in NAMES
            )
    assert {module: names for module, names in found.items() if names} == MEANT


@pytest.mark.parametrize(
    ("table", "name"),
    [("middleware", "bag"), ("middleware", "memory"), ("middleware", "dds"), ("phy", "direct"), ("phy", "ofdm")],
)
def test_our_back_ends_load(table: str, name: str) -> None:
    found = {"middleware": MIDDLEWARE, "phy": PHY}[table].load(name)
    assert found.name == name


@pytest.mark.parametrize(
    ("packages", "table", "name", "remedy"),
    [
        (("cyclonedds", "gr_ros2.middleware.libddsc"), "middleware", "dds", "the installation of gr-ros2"),
        (("rclpy",), "middleware", "rclpy", "a sourced ROS 2 setup"),
        (("gnuradio",), "phy", "ofdm", "apt install gnuradio"),
    ],
)
def test_choosing_what_is_not_installed_names_what_to_install(
    packages: tuple[str, ...], table: str, name: str, remedy: str
) -> None:
    code = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.startswith({packages!r}):
            raise ImportError("blocked")

sys.meta_path.insert(0, Blocked())
from gr_ros2.core.errors import BackendMissingError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
try:
    {table.upper()}.load({name!r})
except BackendMissingError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{table} {name!r} needs" in done.stdout
    assert remedy in done.stdout
