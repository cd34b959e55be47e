"""Back-ends of other packages: found by their entry points, loaded when chosen, harmless where they are broken."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.packages import install, run

ECHO = """
from gr_ros2.middleware import GraphBackend
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.phy.direct import DirectPhy
from gr_ros2.radio.front_end import FrontEnd

class EchoMiddleware(MemoryMiddleware):
    name = "echo"

class EchoPhy(DirectPhy):
    name = "echo"

class EchoFrontEnd(FrontEnd):
    name = "echo"

ROW = GraphBackend("echoes", "EchoMiddleware", "by a row", "nothing", scope="process", localhost_only=True)
"""
ENTRY_POINTS = {
    "gr_ros2.middleware": {
        "echo": "echoes:EchoMiddleware",
        "row": "echoes:ROW",
        "dds": "echoes:EchoMiddleware",
        "broken": "broken:Bus",
        "gone": "no_such_module_at_all:Bus",
        "typo": "echoes:Eco",
        "odd": "echoes:ECHO_IS_NO_CLASS",
        "module": "echoes",
    },
    "gr_ros2.phy": {"echo": "echoes:EchoPhy"},
    "gr_ros2.front_end": {"echo": "echoes:EchoFrontEnd"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("site-packages")
    modules = {"echoes": f"{ECHO}ECHO_IS_NO_CLASS = 5\n", "broken": "import sys\nsys.never_there\n"}
    install(made, "echo-package", modules, ENTRY_POINTS)
    return made


def test_each_family_takes_rows_of_other_packages(folder: Path) -> None:
    done = run(
        folder,
        "-c",
        """
import sys
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
for table in (MIDDLEWARE, PHY, FRONT_ENDS):
    assert list(table)[: len(table.own)] == list(table.own) and len(table) == len(list(table))
    assert "echo" in table and "echo" not in table.own and "echoes" not in sys.modules
for table in (MIDDLEWARE, PHY, FRONT_ENDS):
    print(table.load("echo").__name__, table["echo"].summary)
row = MIDDLEWARE["row"]
print(MIDDLEWARE.load("row").__name__, row.summary, row.scope, row.localhost_only, MIDDLEWARE["echo"].scope)
print(MIDDLEWARE.load("dds").__module__)
""",
    )
    assert done.stdout.splitlines() == [
        "EchoMiddleware of package echo-package",
        "EchoPhy of package echo-package",
        "EchoFrontEnd of package echo-package",
        "EchoMiddleware by a row process True shared",
        "gr_ros2.middleware.dds",  # ours cannot be replaced
    ], done.stderr


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("broken", "broken:Bus, which cannot be loaded (AttributeError: module 'sys' has no attribute 'never_there')"),
        ("gone", "no_such_module_at_all:Bus, which cannot be loaded (ModuleNotFoundError: No module named"),
        ("typo", "echoes:Eco, which cannot be loaded (AttributeError: module 'echoes' has no attribute 'Eco')"),
        ("odd", "echoes:ECHO_IS_NO_CLASS, which is neither a class nor a GraphBackend"),
        ("module", "echoes, which is neither a class nor a GraphBackend"),
    ],
)
def test_a_broken_one_is_named_when_it_is_chosen_and_harms_nobody_else(folder: Path, name: str, why: str) -> None:
    done = run(
        folder,
        "-c",
        f"""
from gr_ros2.core.errors import BackendMissingError
from gr_ros2.middleware import MIDDLEWARE
assert {name!r} in MIDDLEWARE and MIDDLEWARE.load("memory") and MIDDLEWARE.load("echo")
try:
    MIDDLEWARE.load({name!r})
except BackendMissingError as error:
    print(error)
""",
    )
    assert f"middleware {name!r}: package echo-package has it as {why}" in done.stdout, done.stderr


@pytest.mark.slow
def test_the_command_line_takes_them_by_name_and_lives_with_broken_ones(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")
    scenario = tmp_path / "echo.yaml"
    scenario.write_text(
        "{name: echo, registry: table4, duration_s: 1, phy: {name: echo}, "
        "graph: {middleware: echo}, robots: [{direction: send, graph: {domain_id: 41}}, "
        "{direction: receive, graph: {domain_id: 42}}]}"
    )
    ran = run(folder, "-m", "gr_ros2.cli", "run", str(scenario), "--no-report", "--out", str(tmp_path / "out"))
    assert ran.returncode == 0, ran.stderr
    assert '"name": "echo"' in next((tmp_path / "out").glob("*.json")).read_text()
    broken = run(folder, "-m", "gr_ros2.cli", "run", str(scenario), "--set", "graph.middleware=broken")
    assert broken.returncode != 0
    assert "package echo-package has it as broken:Bus" in broken.stderr
    assert "Traceback" not in broken.stderr
    unknown = run(folder, "-m", "gr_ros2.cli", "run", str(scenario), "--set", "phy.name=nothing")
    assert "known are direct, ofdm, gfsk, psk, lora, wifi, modem, echo" in unknown.stderr
