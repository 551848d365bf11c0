"""Imports go one way: cli -> personalize -> {tracker, model}; tracker and model know nothing of each other."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "cli": {"cli", "personalize"},
    "personalize": {"personalize", "tracker", "model"},
    "tracker": {"tracker"},
    "model": {"model"},
}


def imported_packages(source: str) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the direction"
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_go_one_way(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        ours = imported_packages(path.read_text()) & (ALLOWED.keys() | {"tools", "tests", "benchmarks"})
        assert ours <= ALLOWED[package], f"{path.relative_to(ROOT)} imports {ours - ALLOWED[package]}"


# Data sets and head models come as pickles: this one file reads them, and lets none name anything but plain data.
RESTRICTED_READER = ROOT / "personalize/restricted_pickle.py"


def test_nothing_unpickles() -> None:
    for package in ALLOWED:
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            assert "allow_pickle=True" not in text, path
            assert "pickle" not in imported_packages(text) or path == RESTRICTED_READER, path
            assert "torch.load(" not in text or "weights_only=True" in text, path


def test_package_stays_under_60_mb() -> None:
    total = sum(p.stat().st_size for package in ALLOWED for p in (ROOT / package).rglob("*") if p.is_file())
    assert total < 60e6
