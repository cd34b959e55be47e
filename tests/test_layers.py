"""The architecture, read from the sources: who may import whom, and what library code never does."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

import gr_ros2
import gr_ros2.wire

pytestmark = pytest.mark.xdist_group("layers")  # each module is parsed once

ROOT = Path(gr_ros2.__file__).resolve().parents[1]
ROBOT, LAB = "gr_ros2", "gr_ros2_lab"
MODULES = [path.relative_to(ROOT).as_posix() for one in (ROBOT, LAB) for path in sorted((ROOT / one).rglob("*.py"))]

LAYERS = {
    ROBOT: (
        {"core"},
        {"wire", "state"},
        {"settings", "relay"},
        {"link", "calls"},
        {"mac"},
        {"middleware", "compression"},
        {"phy", "grc", "codecs"},
        {"gr"},
        {"paper"},
        {"radio"},
        {"observe"},
        {"dashboard", "doctor"},
        {"cli"},
        {"ros"},
    ),
    LAB: (
        {"sim", "survey"},
        {"medium", "record"},
        {"run", "report"},
        {"study"},
        {"race"},
        {"cli"},
    ),
}
"""Of each package from the bottom up. A part imports itself and what lies below it in its package, not its neighbours.
The laboratory imports the robot's parts, its commands also those that print; a robot's part imports none of it."""

SHELLS = {"cli", "ros"}
"""Parts that print, exit and read argv."""
PURE = {"wire", "link", "mac", "relay", "calls"}
PURE_CODECS = {"backports", "cryptography"}
"""Small codecs and ciphers without IO that these may import beside the standard library."""

CONFINED = {
    "gnuradio": (
        *("gr_ros2/gr/", "gr_ros2/phy/", "gr_ros2/radio/"),
        *("gr_ros2_lab/race/links.py", "gr_ros2_lab/run/passed_on.py"),
    ),
    "pmt": ("gr_ros2/gr/", "gr_ros2/phy/", "gr_ros2/radio/", "gr_ros2_lab/race/links.py"),
    "rclpy": ("gr_ros2/middleware/rclpy.py", "gr_ros2/middleware/rclpy_executor.py", "gr_ros2/ros/"),
    "rcl_interfaces": ("gr_ros2/ros/",),
    "distributed": ("gr_ros2_lab/study/sweep/cluster.py",),
    "zenoh": ("gr_ros2/middleware/zenoh.py", "gr_ros2_lab/race/"),
    "av": ("gr_ros2/codecs/h264.py", "gr_ros2/codecs/video.py", "gr_ros2/codecs/camera.py"),
}
BLOCKED = (*CONFINED, "cyclonedds")
WITHOUT_BACKENDS = (
    "gr_ros2",
    "gr_ros2.wire",
    "gr_ros2.link",
    "gr_ros2.calls",
    "gr_ros2.mac",
    "gr_ros2.settings.registry",
    "gr_ros2.settings.config",
    "gr_ros2.codecs",
    "gr_ros2.compression",
    "gr_ros2.middleware",
    "gr_ros2.middleware.memory",
    "gr_ros2.middleware.bag",
    "gr_ros2.phy",
    "gr_ros2.radio",
    "gr_ros2.radio.config",
    "gr_ros2_lab.sim",
    "gr_ros2_lab.record.ledger",
    "gr_ros2_lab.record.metrics",
    "gr_ros2_lab.record.result",
    "gr_ros2_lab.run.scenario",
    "gr_ros2.cli.main",
)

KNOW_THEIR_VERSION = (
    "gr_ros2/wire/",
    "gr_ros2/paper/",
    "gr_ros2/link/v1/",
    "gr_ros2/mac/",
    "gr_ros2/relay/",
    "gr_ros2/link/reader.py",
)
"""The codec of a version, its engines, and what reads packets without being an end. All others ask a Format."""
FACTORIES = ("gr_ros2/gr/factory.py", "gr_ros2/paper/factory.py")
"""The modules outside ``link`` that make the endpoint of a version."""
PAPER_BLOCKS = ("gr_ros2/paper/blocks.py", "gr_ros2/paper/factory.py", "gr_ros2/paper/settings.py")
"""What of ``paper`` works with a ROS graph; the rest is sans-IO."""
SPEAKS_OF_PACKETS = {"link", "gr", "record", "run", "report", "study", "observe", "dashboard", "settings"}
"""Parts that handle packets and have no bytes of their own, as coders, modems and capture files have."""

_GENERATORS = {"Random", "SystemRandom", "default_rng", "Generator", "SeedSequence", "PCG64", "RandomState"}
"""What makes a generator of one's own; anything else of ``random`` and ``numpy.random`` is the global one."""


@functools.cache
def parsed(module: str) -> ast.Module:
    return ast.parse((ROOT / module).read_text("utf-8"))


def place(module: str) -> tuple[str, str]:
    """Package and part of a module: ``gr_ros2`` and ``link`` of ``gr_ros2/paper/sender.py``."""
    package, inner = module.split("/", maxsplit=1)
    return package, inner.split("/", maxsplit=1)[0].removesuffix(".py")


def part(module: str) -> str:
    return place(module)[1]


@functools.cache
def imports(module: str) -> tuple[str, ...]:
    """Dotted names of everything imported anywhere in a module, in functions too."""
    found = []
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports are absolute"
            assert node.module is not None
            # `from gr_ros2 import core` names a part too.
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(found)


def breaking(rule: Callable[[str], Any], modules: Iterable[str] = MODULES) -> dict[str, Any]:
    """The modules that break a rule, and what the rule says of each."""
    said = {module: rule(module) for module in modules}
    return {module: found for module, found in said.items() if found}


def level(package: str, name: str) -> int:
    found = [number for number, layer in enumerate(LAYERS[package]) if name in layer]
    assert found, f"{package}.{name} stands in no layer; add it to LAYERS"
    return found[0]


def dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


@functools.cache
def calls_and_uses(module: str) -> set[str]:
    """Dotted names as they stand in the source: ``sys.exit``, ``print``, ``np.random.rand``."""
    found = set()
    for node in ast.walk(parsed(module)):
        if isinstance(node, ast.Attribute):
            found.add(dotted(node))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found.add(node.func.id)
    return found


def ours(module: str) -> list[tuple[str, str]]:
    """The parts of both packages that a module imports."""
    names = [name.split(".") for name in imports(module)]
    return [(name[0], name[1]) for name in names if name[0] in LAYERS and len(name) > 1 and name[1] != "__version__"]


def test_arrows_point_down_only() -> None:
    def up(module: str) -> list[tuple[str, str]]:
        package, own = place(module)

        def may(other: str, name: str) -> bool:
            if own == "__init__":
                return False
            if other == package:
                return name == own or level(package, name) < level(package, own)
            return package == LAB and (name not in SHELLS or own in SHELLS)

        return [found for found in ours(module) if not may(*found)]

    assert breaking(up) == {}


def test_no_modules_import_each_other() -> None:
    """Not for types either: two that know each other are one, in two files."""
    names = {module.removesuffix(".py").removesuffix("/__init__").replace("/", "."): module for module in MODULES}

    def imported(module: str) -> set[str]:
        found = set()
        for name in imports(module):
            known = name if name in names else name.rpartition(".")[0]
            if known in names:
                found.add(names[known])
        return found - {module}

    needs = {module: imported(module) for module in MODULES}
    while free := {module for module, others in needs.items() if not others & needs.keys()}:
        needs = {module: others for module, others in needs.items() if module not in free}
    assert {module: sorted(others & needs.keys()) for module, others in needs.items()} == {}


def test_wire_and_link_are_pure() -> None:
    def impure(module: str) -> set[str]:
        outside = {name.split(".")[0] for name in imports(module)} - {ROBOT}
        foreign = outside - set(sys.stdlib_module_names) - PURE_CODECS
        return foreign | outside & {"threading", "time", "socket", "asyncio", "logging", "subprocess"}

    engines = [m for m in MODULES if part(m) in PURE or (part(m) == "paper" and m not in PAPER_BLOCKS)]
    assert breaking(impure, engines) == {}


def test_nothing_but_its_engines_knows_a_version_of_the_wire_format() -> None:
    public = {f"gr_ros2.wire.{name}" for name in gr_ros2.wire.__all__}

    def inside(module: str) -> set[str]:
        known = module.startswith(KNOW_THEIR_VERSION)
        return set() if known else {name for name in imports(module) if name.startswith("gr_ros2.wire.")} - public

    assert breaking(inside) == {}


def test_one_factory_knows_the_engine_of_a_version() -> None:
    """All others work with the two sides of an Endpoint (``link/endpoint.py``)."""

    def engines(module: str) -> list[str]:
        return [name for name in imports(module) if name.startswith(("gr_ros2.paper.endpoint", "gr_ros2.link.v1"))]

    assert list(breaking(engines, [m for m in MODULES if part(m) not in {"wire", "link"}])) == [*FACTORIES]


def test_no_width_of_a_field_stands_outside_of_the_wire() -> None:
    """``x & 255``, ``x % 256``, ``randrange(256)``, ``x << 4``: written by who knows that a field has 8 or 4 bits."""
    widths = {15, 16, 255, 256, 0xFFFF, 1 << 16}

    def written(module: str) -> list[str]:
        found = []
        for node in ast.walk(parsed(module)):
            if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.BitAnd, ast.Mod, ast.LShift, ast.RShift)):
                operands = [side.value for side in (node.left, node.right) if isinstance(side, ast.Constant)]
                if any(isinstance(value, int) and (value in widths or value in (4, 8)) for value in operands):
                    found.append(ast.unparse(node))
            elif isinstance(node, ast.Call) and dotted(node.func).endswith("randrange"):
                given = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
                found += [ast.unparse(node) for value in given if value in widths]
        return found

    own = ("gr_ros2/link/v1/", "gr_ros2/link/reader.py", "gr_ros2/observe/capture.py")
    speaking = [m for m in MODULES if part(m) in SPEAKS_OF_PACKETS and not m.startswith(own)]
    assert breaking(written, speaking) == {}


@pytest.mark.parametrize("package", CONFINED)
def test_back_end_packages_are_imported_in_their_adapters_only(package: str) -> None:
    users = [module for module in MODULES if package in {name.split(".")[0] for name in imports(module)}]
    assert users, f"nothing imports {package}"
    assert [module for module in users if not module.startswith(CONFINED[package])] == []


def test_library_code_never_prints_asks_exits_or_reads_argv() -> None:
    forbidden = {"print", "input", "exit", "quit", "breakpoint", "sys.exit", "sys.argv", "os._exit"}
    library = [module for module in MODULES if part(module) not in SHELLS]
    assert breaking(lambda module: forbidden & calls_and_uses(module), library) == {}


def test_no_module_draws_from_a_global_generator() -> None:
    def draws(module: str) -> set[str]:
        uses = [use.split(".") for use in calls_and_uses(module)]
        drawn = [use for use in uses if use[0] == "random" or use[:2] in (["np", "random"], ["numpy", "random"])]
        names = {use[-1] for use in drawn} - {"random"}
        from_random = {name for name in imports(module) if name.startswith(("random.", "numpy.random."))}
        return (names | {name.rsplit(".", 1)[1] for name in from_random}) - _GENERATORS

    assert breaking(draws) == {}


def test_no_annotation_is_a_bare_class_variable() -> None:
    """Write ``ClassVar[Any]``: pydantic evaluates annotations, and Python 3.10 refuses the text ``ClassVar``."""

    def bare(module: str) -> list[int]:
        found = [node for node in ast.walk(parsed(module)) if isinstance(node, ast.AnnAssign)]
        return [node.lineno for node in found if dotted(node.annotation) == "ClassVar"]

    assert breaking(bare) == {}


def test_every_module_says_what_it_is() -> None:
    assert breaking(lambda module: parsed(module).body and not ast.get_docstring(parsed(module))) == {}


def test_everything_but_the_adapters_imports_without_any_back_end() -> None:
    wanted = [name for name in WITHOUT_BACKENDS if (ROOT / name.replace(".", "/")).with_suffix(".py").exists()]
    wanted += [name for name in WITHOUT_BACKENDS if (ROOT / name.replace(".", "/") / "__init__.py").exists()]
    assert set(wanted) == set(WITHOUT_BACKENDS)
    wanted += [m.removesuffix(".py").replace("/", ".") for m in MODULES if part(m) in PURE]
    code = f"""
import sys
from importlib import import_module

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BLOCKED!r}:
            raise ImportError(f"{{name}} is blocked")

sys.meta_path.insert(0, Blocked())
for name in {wanted!r}:
    import_module(name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_picture_of_the_architecture_shows_these_layers() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
    picture = page.split("lies below it:", maxsplit=1)[1].split("```", maxsplit=1)[0]
    for package, shown in zip(LAYERS, picture.strip().split("\n\n"), strict=True):
        name, layers = shown.split(maxsplit=1)
        assert (name, [set(layer.split()) for layer in layers.split("│")]) == (package, [*LAYERS[package]])
