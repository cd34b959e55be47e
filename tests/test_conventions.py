"""What holds of every test: it says what it expects."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
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


@pytest.mark.parametrize("path", sorted(TESTS.rglob("test_*.py")), ids=lambda path: str(path.relative_to(TESTS)))
def test_every_test_asserts_something_a_reader_can_see(path: Path) -> None:
    assert silent(ast.parse(path.read_text())) == []


def test_a_test_without_an_assertion_is_found() -> None:
    helped, alone = "def helper(): assert 1\ndef test_one(): helper()", "def test_two(): wait_for(print)"
    assert silent(ast.parse(f"{helped}\n{alone}\ndef test_three(): print()")) == ["test_three"]
