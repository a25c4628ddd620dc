"""Measure how well the tests detect faults: plant faults one at a time, and count the detected.

Each fault is a sign, a bound, a unit, an index, a removed call or two swapped arguments. It is
planted in a copy of this checkout, whose tests then run until one fails: those of the folder that
mirrors the faulty package, and a few of whole environments. A failing test counts only if it fails
again, and passes without the fault.

    python tests/measure/plant_faults.py --faults 60 --seed 0 --jobs 2
"""

from __future__ import annotations

import argparse
import ast
import difflib
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
UNTESTED = re.compile(r"/(ros2|ros_watchdog_child|ros/node|ros/policy|__init__|__main__)\.py$")
"""Files whose tests need another installation (`make test-ros`), and files without logic."""
ENVIRONMENTS = ["tests/envs", "tests/vector/test_task.py", "tests/test_robot.py"]
"""Tests of whole environments, which also run for faults outside `tools`."""
ELSEWHERE = {"ros": "links"}
"""Folders of tests that have another name than the package."""
MESSAGES = (ast.Raise, ast.Assert, ast.JoinedStr)
TYPES = ("annotation", "returns", "decorator_list", "bases")
TEXTS = (ast.JoinedStr, ast.List, ast.ListComp, ast.Tuple)
"""What + joins without being a number."""
LOGS = ("LOG.", "warn")
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
NAMES = {
    "min": "max",
    "max": "min",
    "radians": "degrees",
    "degrees": "radians",
    "deg2rad": "rad2deg",
    "rad2deg": "deg2rad",
}
SYMMETRIC = {"hypot", "isclose", "max", "maximum", "min", "minimum", "dot"}
"""Functions whose arguments may be swapped."""
LIMIT = 900.0
"""Longest duration of a run of tests [s]."""
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+::.+?)(?: - .*)?$", re.MULTILINE)
COMPILED = re.compile(r"^\s*@(jit|loop|subroutine|compilable|overloads)\b|= (jit|loop)\(", re.M)


Assignment = tuple[str, ast.AST, str, object]
"""Kind of fault, node, attribute and the value that makes it faulty."""


class Change(NamedTuple):
    """A change of a syntax tree that is a fault."""

    kind: str
    line: int
    apply: Callable[[], None]


class Fault(NamedTuple):
    """A faulty version of a file."""

    file: str
    kind: str
    line: int
    source: str

    def describe(self) -> str:
        """Show file, line and difference."""
        sound = ast.unparse(ast.parse((ROOT / self.file).read_text(encoding="utf-8")))
        lines = difflib.unified_diff(sound.splitlines(), self.source.splitlines(), n=0)
        changes = [line for line in lines if not line.startswith(("---", "+++", "@@"))]
        return "\n".join([f"{self.file}:{self.line} {self.kind}", *changes])


def list_changes(node: ast.AST) -> Iterator[Change]:
    """Find faults in the code below a node, but not in types, messages and logs."""
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            is_code = isinstance(child, ast.AST) and not isinstance(child, MESSAGES)
            if name in TYPES or not is_code:
                continue
            if isinstance(child, ast.Call) and ast.unparse(child.func).startswith(LOGS):
                continue
            for change in (change_operator, change_value, change_call):
                for kind, owner, field, faulty in change(child):
                    yield Change(kind, child.lineno, partial(setattr, owner, field, faulty))
            yield from list_changes(child)


def change_operator(node: ast.AST) -> Iterator[Assignment]:
    """Flip a sign, or move a bound."""
    match node:
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as operator, right=right):
            if not any(map(is_text, (left, right))):
                yield "sign", node, "op", OPERATORS[type(operator)]()
        case ast.Compare(ops=[operator]) if type(operator) in OPERATORS:
            yield "bound", node, "ops", [OPERATORS[type(operator)]()]
        case ast.UnaryOp(op=ast.USub()):
            yield "sign", node, "op", ast.UAdd()


def change_value(node: ast.AST) -> Iterator[Assignment]:
    """Change a constant, an index or the end of a slice."""
    match node:
        case ast.Constant(value=float(value)) if value:
            yield "unit", node, "value", value * 1.1
        case ast.Subscript(slice=ast.Constant(value=int(value)) as index):
            yield "index", index, "value", value + 1
        case ast.Slice(lower=lower, upper=upper):
            for field, end in (("lower", lower), ("upper", upper)):
                if end is not None:
                    yield "index", node, field, ast.BinOp(end, ast.Add(), ast.Constant(1))


def change_call(node: ast.AST) -> Iterator[Assignment]:
    """Call another function, remove a call or swap its first two arguments."""
    match node:
        case ast.Expr(value=ast.Call(func=function)):
            if not ast.unparse(function).startswith(LOGS):
                yield "removed call", node, "value", ast.Constant(None)
        case ast.Call(func=function, args=arguments):
            name = ast.unparse(function).rpartition(".")[2]
            if name in NAMES:
                kind = "bound" if name in ("min", "max") else "unit"
                field = "attr" if isinstance(function, ast.Attribute) else "id"
                yield kind, function, field, NAMES[name]
            first_two = {ast.unparse(argument) for argument in arguments[:2]}
            is_starred = any(text.startswith("*") for text in first_two)
            if len(first_two) == 2 and not is_starred and name not in SYMMETRIC:
                yield "swapped arguments", node, "args", [*arguments[1::-1], *arguments[2:]]


def is_text(node: ast.AST) -> bool:
    """Return whether + joins this to a text or a list."""
    return isinstance(node, TEXTS) or isinstance(getattr(node, "value", 0), str)


def plant(file: str, source: str, number: int) -> Fault:
    """Plant a fault, by its place in the list of all changes of the file's source."""
    tree = ast.parse(source)
    change = list(list_changes(tree))[number]
    change.apply()
    return Fault(file, change.kind, change.line, ast.unparse(tree))


def choose_faults(count: int, seed: int) -> list[Fault]:
    """Choose faults: all kinds equally often, and files in proportion to their size."""
    kinds = defaultdict(list)
    for path in sorted((ROOT / "acsar_gym").rglob("*.py")):
        if not UNTESTED.search(path.as_posix()):
            file = str(path.relative_to(ROOT))
            source = path.read_text(encoding="utf-8")
            for number, change in enumerate(list_changes(ast.parse(source))):
                kinds[change.kind].append((file, source, number))

    generator = random.Random(seed)
    for places in kinds.values():
        generator.shuffle(places)
    names = sorted(kinds)
    return [plant(*kinds[names[i % len(names)]][i // len(names)]) for i in range(count)]


def find_tests(file: str) -> list[str]:
    """Return the tests that mirror a file of the package, and those of whole environments."""
    path = Path(file).relative_to("acsar_gym")
    folder = ELSEWHERE.get(str(path.parent), str(path.parent))
    if folder in (".", "tools"):
        candidates = [f"{folder}/test_{path.stem}*.py", "test_protocol*.py"]
    else:
        candidates = [folder, str(path.parent.parent), f"test_{path.parent.name}*.py"]
    matches = (sorted((ROOT / "tests").glob(name)) for name in candidates if name != ".")
    tests = [str(test.relative_to(ROOT)) for test in next(filter(None, matches))]
    return tests if path.parts[0] == "tools" else list(dict.fromkeys([*tests, *ENVIRONMENTS]))


def has_compiled_code(file: str) -> bool:
    """Return whether numba compiles functions of a file's folder, which use its constants."""
    sources = (ROOT / file).parent.glob("*.py")
    return any(COMPILED.search(source.read_text(encoding="utf-8")) for source in sources)


class Copy:
    """A copy of the checkout in which faults are planted, one at a time."""

    def __init__(self, folder: Path) -> None:
        self._root = folder / "tree"
        self._folder = folder
        (folder / "shared").mkdir(parents=True)
        skipped = shutil.ignore_patterns(".*", "build", "dist", "runs", "__pycache__")
        shutil.copytree(ROOT, self._root, ignore=skipped)

    def detect(self, fault: Fault) -> str:
        """Return the test that detects a fault, or "" if none does."""
        share = not has_compiled_code(fault.file)
        file = self._root / fault.file
        sound = file.read_bytes()
        times = file.stat()
        options = ["-x"]
        while True:
            file.write_text(fault.source, encoding="utf-8")
            failed = self._run([*options, *find_tests(fault.file)], share=share)
            fails_again = failed and ("::" not in failed or self._run([failed], share=share))
            file.write_bytes(sound)
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))

            # A test must fail again with the fault, and pass without.
            if not failed or "::" not in failed:
                return failed
            if fails_again and not self._run([failed], share=True):
                return failed
            options.append(f"--deselect={failed}")

    def _run(self, arguments: list[str], *, share: bool) -> str:
        """Run tests, and return what failed. "" if all pass.

        Compiled code is shared with other runs only if it can't have the fault.
        """
        compiled = self._folder / "compiled"
        shutil.rmtree(compiled, ignore_errors=True)
        compiled.mkdir()
        environment = {
            **os.environ,
            "PYTHONPATH": str(self._root),
            "NUMBA_CACHE_DIR": str(compiled),
            "CI": "1",  # the same random examples each time
        }
        run = partial(subprocess.run, env=environment, capture_output=True, text=True, check=False)
        if share:
            script = "from acsar_gym.jit import find_folder; print(find_folder('acsar_gym.x', ''))"
            if name := Path(run([sys.executable, "-c", script]).stdout.strip()).name:
                (compiled / name).symlink_to(self._folder / "shared")

        options = ["-q", "--tb=no", "-p", "no:cacheprovider", f"--basetemp={self._folder / 'tmp'}"]
        command = [sys.executable, "-m", "pytest", *options, *arguments]
        try:
            done = run(command, cwd=self._root, timeout=LIMIT)
        except subprocess.TimeoutExpired:
            return f"no end after {LIMIT:g} s"
        if done.returncode in (0, 5):
            return ""
        failed = FAILED.search(done.stdout)
        return failed[1] if failed else f"pytest ended with {done.returncode}"


def main() -> None:
    """Plant faults, and report the share that the tests detect."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    chosen = choose_faults(options.faults, options.seed)
    descriptions = [fault.describe() for fault in chosen]  # of the sources as they are now
    copies: queue.SimpleQueue[Copy] = queue.SimpleQueue()

    def detect(fault: Fault) -> str:
        copy = copies.get()
        test = copy.detect(fault)
        copies.put(copy)
        print(f"{fault.file}:{fault.line} {fault.kind}: {test or 'NOT DETECTED'}", flush=True)
        return test

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        for job in range(options.jobs):
            copies.put(Copy(Path(folder, str(job))))
        tests = list(pool.map(detect, chosen))
    undetected = [text for text, test in zip(descriptions, tests, strict=True) if not test]
    print(f"\ndetected {len(tests) - len(undetected)} of {len(tests)} faults, not these:\n")
    print(*undetected, sep="\n\n")


if __name__ == "__main__":
    main()
