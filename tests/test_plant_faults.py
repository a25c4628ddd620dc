"""Faults that `make faults` plants are those of the named kinds, and leave the rest as it is."""

from __future__ import annotations

import ast

import pytest
from plant_faults import ROOT, choose_faults, find_tests, list_changes, plant

SOURCE = '''
def area(sides: tuple[float, float] = (1.5, 2.0)) -> float:
    """Text + text."""
    LOG.info("%s", sides[0])
    check(sides)
    if max(sides) < 0:
        raise ValueError(f"{sides[1]}" + str(sides[0]))
    return -sides[0] - sum(sides[1:], start)
'''


def test_faults_are_of_each_kind() -> None:
    tree = ast.parse(SOURCE)
    sound = ast.unparse(tree).splitlines()
    faults = [plant("area.py", SOURCE, number) for number in range(len(list(list_changes(tree))))]
    changed = [
        new
        for fault in faults
        for old, new in zip(sound, fault.source.splitlines(), strict=True)
        if old != new
    ]

    head = "def area(sides: tuple[float, float]="
    end = "    return "
    assert sorted(changed) == sorted(
        [
            f"{head}(1.6500000000000001, 2.0)) -> float:",
            f"{head}(1.5, 2.2)) -> float:",
            "    None",
            "    if min(sides) < 0:",
            "    if max(sides) <= 0:",
            f"{end}-sides[0] + sum(sides[1:], start)",
            f"{end}+sides[0] - sum(sides[1:], start)",
            f"{end}-sides[1] - sum(sides[1:], start)",
            f"{end}-sides[0] - sum(sides[1 + 1:], start)",
            f"{end}-sides[0] - sum(start, sides[1:])",
        ]
    )
    kinds = {fault.kind for fault in choose_faults(6, seed=0)}
    assert kinds == {"sign", "bound", "unit", "index", "removed call", "swapped arguments"}


@pytest.mark.parametrize(
    ("file", "test"),
    [
        ("odometry.py", "tests/test_odometry.py"),
        ("vector/kernel/drive.py", "tests/vector"),
        ("tools/cli/commands/drive.py", "tests/tools/cli"),
    ],
)
def test_faults_are_tested_by_the_folder_of_the_package(file: str, test: str) -> None:
    assert test in find_tests(f"acsar_gym/{file}")
    assert all((ROOT / name).exists() for name in find_tests(f"acsar_gym/{file}"))
