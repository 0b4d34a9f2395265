"""The page of promises: every test that it names exists, and the book leads to it."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/promises.md").read_text(encoding="utf-8")


def rows() -> list[tuple[str, list[str]]]:
    """Each promise with the tests that hold it."""
    body = PAGE.partition("## In flight")[2].partition("## Beside others")[0]
    lines = [line.strip("|").rsplit("|", 1) for line in body.splitlines() if line.startswith("| ")]
    return [
        (promise.strip(), re.findall(r"`(\w+)`", tests)) for promise, tests in lines if promise.strip() != "promise"
    ]


def every_test() -> dict[str, ast.FunctionDef]:
    """Every test of the repository by name."""
    found = {}
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
                found[node.name] = node
    return found


def test_each_promise_names_tests_that_exist():
    known = every_test()
    assert len(rows()) > 25
    for promise, names in rows():
        assert names, promise
        for name in names:
            assert name in known, f"{promise}: no test {name}"
            assert any(isinstance(node, ast.Assert | ast.Call) for node in ast.walk(known[name])), f"{name} is empty"


def test_the_book_leads_to_the_page_and_the_page_names_those_it_compares_with():
    assert "(promises.md)" in (ROOT / "docs/index.md").read_text(encoding="utf-8")
    beside = PAGE.partition("## Beside others")[2]
    for name in ("PX4", "Crazyflie", "Betaflight", "rosbag2"):
        assert re.search(rf"{name}[^|]*\(https://", beside), f"no source for {name}"
