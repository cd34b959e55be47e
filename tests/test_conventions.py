"""What holds of every test, of the names of classes, and of docstrings.

A test says what it expects, and expects nothing of the machine's speed. A class has its name to itself. What is public
says what it is.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
ROOT = TESTS.parent
MODULES = sorted(ROOT.glob("gr_ros2*/**/*.py"))
EXPECTING = {"raises", "fail", "wait_for"}
"""Calls that fail a test which does not see what it expects; so do helpers named ``check…``."""


def expects(function: ast.AST, helpers: set[str]) -> bool:
    """Whether something in a function can fail because of what it sees."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name in helpers or name.startswith("check"):
                return True
    return False


def silent(tree: ast.Module) -> list[str]:
    """Tests of a module that expect nothing, neither themselves nor by a function of the module."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    helpers = EXPECTING | {each.name for each in functions if expects(each, EXPECTING)}
    return [each.name for each in functions if each.name.startswith("test_") and not expects(each, helpers)]


CLOCKS = {"monotonic", "perf_counter", "process_time", "thread_time", "time"}
FIRST = {"join", "settimeout", "wait"}
GIVING_UP = {*FIRST, "acquire", "communicate", "run", "urlopen", "wait_for"}
"""What takes a timeout, as its argument ``timeout`` or as its first; a number there is a bound on the machine."""


def is_clock(node: ast.AST) -> bool:
    """Whether a value is what a clock says now, whatever module the clock is of, in seconds or nanoseconds."""
    return isinstance(node, ast.Call) and name_of(node.func).removesuffix("_ns") in CLOCKS


def name_of(node: ast.AST) -> str:
    """Of a variable, an attribute, or what is indexed or called on; '' of anything else."""
    while isinstance(node, ast.Subscript):
        node = node.value
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def clocked(tree: ast.Module) -> tuple[set[str], set[str]]:
    """Names that hold readings of a clock, and those that hold differences of such."""
    readings: set[str] = set()
    durations: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and name_of(node.func) == "append" and any(map(is_clock, node.args)):
            readings.add(name_of(node.func.value))  # type: ignore[attr-defined]
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            names = {name_of(target) for target in (node.targets if isinstance(node, ast.Assign) else [node.target])}
            if is_clock(node.value):
                readings |= names
            elif spans(node.value, readings, durations):
                durations |= names
    return readings - {""}, durations - {""}


def spans(node: ast.AST, readings: set[str], durations: set[str]) -> bool:
    """Whether a value is a time that has passed, or a point in time that moves with the clock."""
    for part in ast.walk(node):
        sides = (part.left, part.right) if isinstance(part, ast.BinOp) and isinstance(part.op, ast.Sub) else ()
        if name_of(part) in durations or any(is_clock(side) or name_of(side) in readings for side in sides):
            return True
    return False


def hurried(tree: ast.Module) -> list[int]:
    """Lines that fail on a slow machine: a time that has to be short enough, and patience given as a number."""
    readings, durations = clocked(tree)
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            for left, sense, right in zip(sides[:-1], node.ops, sides[1:], strict=True):
                less = left if isinstance(sense, ast.Lt | ast.LtE) else right
                if isinstance(sense, ast.Lt | ast.LtE | ast.Gt | ast.GtE) and (
                    is_clock(less) or spans(less, readings, durations)
                ):
                    found.append(node.lineno)
        elif isinstance(node, ast.Call) and name_of(node.func) in GIVING_UP:
            named = [word.value for word in node.keywords if word.arg == "timeout"]
            given = named or (node.args if name_of(node.func) in FIRST else [])
            if len(given) == 1 and isinstance(given[0], ast.Constant) and type(given[0].value) in (int, float):
                found += [node.lineno] * (given[0].value >= 1)
    return sorted(found)


def test_every_test_asserts_something_a_reader_can_see() -> None:
    said = {str(path): silent(ast.parse(path.read_text())) for path in TESTS.rglob("test_*.py")}
    assert {path: names for path, names in said.items() if names} == {}


def test_no_test_bounds_the_time_that_it_takes() -> None:
    """Count work (tests.work), compare with a yardstick measured beside it, or measure it in bench/."""
    paths = [path for path in TESTS.rglob("*.py") if path.name != "waiting.py"]
    said = {str(path): hurried(ast.parse(path.read_text())) for path in paths}
    assert {path: lines for path, lines in said.items() if lines} == {}


@pytest.mark.parametrize(
    "text",
    [
        "began = time.monotonic()\nassert time.monotonic() - began < 2",
        "took = perf.perf_counter() - began\nassert 5 > took",
        "heard.append(time.monotonic())\nassert heard[-1] - heard[0] <= 16",
        "self.began = time.time()\nend = time.time()\ntook = end - self.began\nassert 0 < took < 20",
        "while time.monotonic() < end: pass",
        "assert abs(stamp - time.time()) < 60",
        "process.wait(20)",
        "process.communicate(timeout=30)",
        "thread.join(5)",
        "subprocess.run(command, timeout=60)",
    ],
)
def test_a_bound_on_time_is_found(text: str) -> None:
    assert hurried(ast.parse(text)) != []


@pytest.mark.parametrize(
    "text",
    [
        "began = time.monotonic()\nassert time.monotonic() - began >= 0.1",
        "before = time.time()\nassert before <= stamp <= time.time()",
        "process.wait(PATIENCE_S)\nprocess.wait()\nstop.wait(0.01)\n', '.join(words)",
        "took = 3.0 - 1.0\nassert took < 5",
    ],
)
def test_what_a_slow_machine_does_not_break_is_left_alone(text: str) -> None:
    assert hurried(ast.parse(text)) == []


def test_a_test_without_an_assertion_is_found() -> None:
    helped, alone = "def helper(): assert 1\ndef test_one(): helper()", "def test_two(): wait_for(print)"
    assert silent(ast.parse(f"{helped}\n{alone}\ndef test_three(): print()")) == ["test_three"]


def shared(modules: Iterable[tuple[str, ast.Module]]) -> dict[str, list[str]]:
    """Names of classes that several modules define, with these modules: a public name of any two modules, a private
    one of two modules of one folder."""
    found: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for module, tree in modules:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                folder = "/".join(module.split("/")[:-1][:2]) if node.name.startswith("_") else ""
                found[folder, node.name].append(module)
    return {name: modules for (_, name), modules in found.items() if len(modules) > 1}


def test_a_class_has_its_name_to_itself() -> None:
    assert shared((str(path.relative_to(ROOT)), ast.parse(path.read_text())) for path in MODULES) == {}


def test_two_classes_of_one_name_are_found() -> None:
    one, two = ast.parse("class Pace: ...\nclass _End: ..."), ast.parse("class Pace: ...\nclass _End: ...")
    assert shared([("a/one.py", one), ("b/two.py", two)]) == {"Pace": ["a/one.py", "b/two.py"]}
    assert set(shared([("a/one.py", one), ("a/two.py", two)])) == {"Pace", "_End"}


def undocumented(trees: Iterable[ast.Module]) -> set[str]:
    """Public classes, functions and methods without a docstring. A method that a base class or a protocol has says
    what that says; of a base class from elsewhere, every method may be. A class may say it of its properties."""
    trees = list(trees)
    classes = {node.name: node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    known = {"ABC", "Protocol", "Generic", "NamedTuple", "Enum", "str", "object"}

    protocols = {
        node.name
        for one in classes.values()
        if "Protocol" in map(name_of, one.bases)
        for node in one.body
        if isinstance(node, ast.FunctionDef) and ast.get_docstring(node)
    }

    def overrides(method: str, bases: list[ast.expr]) -> bool:
        names = {name_of(base) for base in bases} - known
        return method in protocols or any(
            name not in classes
            or any(getattr(node, "name", "") == method for node in classes[name].body)
            or overrides(method, classes[name].bases)
            for name in names
        )

    def says(node: ast.stmt) -> bool:
        """Whether something needs no docstring, or has one."""
        if not isinstance(node, ast.ClassDef | ast.FunctionDef) or node.name.startswith("_"):
            return True
        return bool(ast.get_docstring(node)) or "setter" in map(name_of, node.decorator_list)

    found = {node.name for tree in trees for node in tree.body if not says(node)}
    for name, one in classes.items():
        if not name.startswith("_"):
            told = ast.get_docstring(one) or ""
            quiet = [node.name for node in one.body if not says(node) and f":ivar {node.name}:" not in told]
            found |= {f"{name}.{method}" for method in quiet if not overrides(method, one.bases)}
    return found


def test_what_is_public_has_a_docstring() -> None:
    found = undocumented(ast.parse(path.read_text()) for path in MODULES)
    assert found == set()


def test_what_has_no_docstring_is_found() -> None:
    base = ast.parse('class Base(ABC):\n "x"\n def close(self): ...\n def read(self): "y"\ndef alone(): ...')
    derived = ast.parse(
        'class End(Base):\n "x"\n def close(self): ...\n def more(self): ...\n def _own(self): ...\n'
        'class Page(Handler):\n "x"\n def get(self): ...\nclass _Hidden:\n def get(self): ...'
    )
    assert undocumented([base, derived]) == {"Base.close", "alone", "End.more"}
