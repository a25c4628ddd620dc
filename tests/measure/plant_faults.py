"""Measure how well the tests detect faults: plant faults one at a time, and count the detected.

Each fault is a sign, a bound, a unit, an index, a removed call or two swapped arguments. It is
planted in a copy of this checkout, whose tests then run until one fails: those of the folder that
mirrors the faulty package, and a few of whole environments. A failing test counts only if it fails
again, and passes without the fault.

    python tests/plant_faults.py --faults 60 --seed 0 --jobs 2
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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

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
OPERATORS: dict[type, tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
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

Change = tuple[str, "Place", str]
"""Kind of fault, place and text that is put there."""
Place = tuple[int, int, int, int]
"""First line and column, last line and column, as in `ast`."""


@dataclass(frozen=True)
class Fault:
    """Text that replaces a part of a file."""

    file: str
    kind: str
    place: Place
    text: str

    def apply(self, source: str) -> str:
        """Return the source with the fault."""
        lines = source.encode().splitlines(keepends=True)
        first, start, last, end = self.place
        faulty = lines[first - 1][:start] + self.text.encode() + lines[last - 1][end:]
        return b"".join([*lines[: first - 1], faulty, *lines[last:]]).decode()

    def describe(self) -> str:
        """Show file, line and difference."""
        source = (ROOT / self.file).read_text(encoding="utf-8")
        lines = difflib.unified_diff(source.splitlines(), self.apply(source).splitlines(), n=0)
        changes = [line for line in lines if not line.startswith(("---", "+++", "@@"))]
        return "\n".join([f"{self.file}:{self.place[0]} {self.kind}", *changes])


def list_faults(file: str, source: str) -> list[Fault]:
    """List all faults that can be planted in the source of a file."""
    return [Fault(file, *change) for change in walk(ast.parse(source), source)]


def walk(node: ast.AST, source: str) -> Iterator[Change]:
    """Find faults in the code below a node, but not in types, messages and logs."""
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            is_code = isinstance(child, ast.AST) and not isinstance(child, MESSAGES)
            if name in TYPES or not is_code:
                continue
            if isinstance(child, ast.Call) and ast.unparse(child.func).startswith(("LOG.", "warn")):
                continue
            yield from change_operator(child, source)
            yield from change_value(child)
            yield from change_call(child)
            yield from walk(child, source)


def change_operator(node: ast.AST, source: str) -> Iterator[Change]:
    """Flip a sign, or move a bound."""
    match node:
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as operator, right=right):
            kind = "sign"
        case ast.Compare(left=left, ops=[operator], comparators=[right]):
            kind = "bound"
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            yield "sign", place_of(node), ast.unparse(operand)
            return
        case _:
            return

    texts = [isinstance(getattr(side, "value", 0), str) for side in (left, right)]
    if type(operator) in OPERATORS and not any(texts) and not isinstance(left, TEXTS):
        place: Place = (*place_of(left)[2:], *place_of(right)[:2])
        lines = source.encode().splitlines(keepends=True)[place[0] - 1 : place[2]]
        lines[-1] = lines[-1][: place[3]]
        lines[0] = lines[0][place[1] :]
        text = b"".join(lines).decode()
        yield kind, place, text.replace(*OPERATORS[type(operator)], 1)


def change_value(node: ast.AST) -> Iterator[Change]:
    """Change a constant, an index or the end of a slice."""
    match node:
        case ast.Constant(value=float(value)) if value:
            yield "unit", place_of(node), repr(value * 1.1)
        case ast.Subscript(slice=ast.Constant(value=int(value)) as index):
            yield "index", place_of(index), str(value + 1)
        case ast.Slice(lower=lower, upper=upper):
            for end in (lower, upper):
                if end is not None:
                    yield "index", place_of(end), f"{ast.unparse(end)} + 1"


def change_call(node: ast.AST) -> Iterator[Change]:
    """Call another function, remove a call or swap its first two arguments."""
    match node:
        case ast.Expr(value=ast.Call(func=function)):
            if not ast.unparse(function).startswith(("LOG.", "warn")):
                yield "removed call", place_of(node), "pass"
        case ast.Call(func=function, args=arguments):
            module, _, name = ast.unparse(function).rpartition(".")
            if name in NAMES:
                kind = "bound" if name in ("min", "max") else "unit"
                yield kind, place_of(function), f"{module}.{NAMES[name]}".lstrip(".")
            texts = [ast.unparse(argument) for argument in arguments[:2]]
            is_starred = any(text.startswith("*") for text in texts)
            if len({*texts}) == 2 and not is_starred and name not in SYMMETRIC:
                place: Place = (*place_of(arguments[0])[:2], *place_of(arguments[1])[2:])
                yield "swapped arguments", place, ", ".join(reversed(texts))


def place_of(node: ast.expr | ast.stmt) -> Place:
    """Return the place of a node in its source."""
    return node.lineno, node.col_offset, node.end_lineno or 0, node.end_col_offset or 0


def choose(faults: list[Fault], count: int, seed: int) -> list[Fault]:
    """Choose faults: all kinds equally often, and files in proportion to their size."""
    kinds = defaultdict(list)
    for fault in faults:
        kinds[fault.kind].append(fault)
    generator = random.Random(seed)
    for kind in kinds.values():
        generator.shuffle(kind)
    names = sorted(kinds)
    return [kinds[names[i % len(names)]][i // len(names)] for i in range(count)]


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


def find_compiled(root: Path) -> set[str]:
    """List files whose functions numba compiles, and those whose constants these functions use."""
    compiled: set[str] = set()
    for path in (root / "acsar_gym").rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        if not COMPILED.search(source):
            continue
        compiled.add(str(path.relative_to(root)))
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and any(name.name.isupper() for name in node.names):
                module = str(node.module).replace(".", "/")
                compiled.add(f"{module}.py")
                compiled |= {str(file.relative_to(root)) for file in root.glob(f"{module}/*.py")}
    return compiled | {"acsar_gym/kinematics.py", "acsar_gym/odometry.py"}


class Copy:
    """A copy of the checkout in which faults are planted, one at a time."""

    def __init__(self, folder: Path) -> None:
        self._root = folder / "tree"
        self._folder = folder
        (folder / "shared").mkdir(parents=True)
        skipped = shutil.ignore_patterns(".*", "build", "dist", "runs", "__pycache__")
        shutil.copytree(ROOT, self._root, ignore=skipped)
        self._compiled = find_compiled(self._root)

    def detect(self, fault: Fault) -> str:
        """Return the test that detects a fault, or "" if none does."""
        options = ["-x"]
        while failed := self._run(fault, [*options, *find_tests(fault.file)]):
            # A test must fail again with the fault, and pass without.
            if "::" not in failed or (self._run(fault, [failed]) and not self._run(None, [failed])):
                return failed
            options.append(f"--deselect={failed}")
        return ""

    def _run(self, fault: Fault | None, arguments: list[str]) -> str:
        """Run tests with or without a fault, and return what failed. "" if all pass."""
        if fault is None:
            return self._pytest(arguments, share=True)
        file = self._root / fault.file
        sound = file.read_bytes()
        times = file.stat()
        file.write_text(fault.apply(sound.decode()), encoding="utf-8")
        try:
            return self._pytest(arguments, share=fault.file not in self._compiled)
        finally:
            file.write_bytes(sound)
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))

    def _pytest(self, arguments: list[str], *, share: bool) -> str:
        """Run pytest. Compiled code is shared with other runs only if it can't have the fault."""
        compiled = self._folder / "compiled"
        shutil.rmtree(compiled, ignore_errors=True)
        compiled.mkdir()
        environment = {
            **os.environ,
            "PYTHONPATH": str(self._root),
            "NUMBA_CACHE_DIR": str(compiled),
            "CI": "1",  # the same random examples each time
        }
        if share:
            script = "from acsar_gym.jit import find_folder; print(find_folder('acsar_gym.x', ''))"
            done = subprocess.run(
                [sys.executable, "-c", script], env=environment, capture_output=True, check=False
            )
            if name := Path(done.stdout.decode().strip()).name:
                (compiled / name).symlink_to(self._folder / "shared")

        options = ["-q", "--tb=no", "-p", "no:cacheprovider", f"--basetemp={self._folder / 'tmp'}"]
        try:
            done = subprocess.run(
                [sys.executable, "-m", "pytest", *options, *arguments],
                cwd=self._root,
                env=environment,
                capture_output=True,
                timeout=LIMIT,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"no end after {LIMIT:g} s"
        if done.returncode in (0, 5):
            return ""
        failed = FAILED.search(done.stdout.decode())
        return failed[1] if failed else f"pytest ended with {done.returncode}"


def main() -> None:
    """Plant faults, and report the share that the tests detect."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()

    faults = [
        fault
        for path in sorted((ROOT / "acsar_gym").rglob("*.py"))
        if not UNTESTED.search(path.as_posix())
        for fault in list_faults(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8"))
    ]
    chosen = choose(faults, options.faults, options.seed)
    descriptions = [fault.describe() for fault in chosen]  # of the sources as they are now
    copies: queue.SimpleQueue[Copy] = queue.SimpleQueue()

    def detect(fault: Fault) -> str:
        copy = copies.get()
        test = copy.detect(fault)
        copies.put(copy)
        place = f"{fault.file}:{fault.place[0]}"
        print(f"{place} {fault.kind}: {test or 'NOT DETECTED'}", flush=True)
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
