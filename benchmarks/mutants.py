"""Do the tests notice small faults of the code? ``python -m benchmarks.mutants``.

A fixed seed draws places in functions of `model` and `service`. Each is changed in a copy of the
repository, where the tests that cover its line are run: they should fail. Which tests cover a line
is in ``.coverage``, which ``make coverage`` writes.

Mutation operators are those of Offutt et al. (1996): comparisons, arithmetic and logical operators,
constants, negated conditions and return values.
"""

import argparse
import ast
import copy
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from coverage import CoverageData

from benchmarks import data_folder
from benchmarks.record import ROOT, log_row, proportion, recording

SEED = 47
PACKAGES = ("model", "service")
TIME_LIMIT_S = 900
"""A mutant whose tests take longer, such as one with an endless loop, is found."""

LEFT_OUT = (".git", ".venv*", "out", "runs", "build", "__pycache__", ".*_cache", ".hypothesis")

_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


@dataclass(frozen=True)
class Mutant:
    """A changed expression: where it is, what it was and what it becomes."""

    path: str
    line: int
    column: int
    before: str
    after: str

    def __str__(self) -> str:
        """``path:line before -> after``, each on one line."""
        texts = (" ".join(text.split())[:60] for text in (self.before, self.after))
        return f"{self.path}:{self.line} " + " -> ".join(texts)

    def write(self, root: Path) -> None:
        """Change the file below ``root``."""
        path = root / self.path
        lines = path.read_bytes().splitlines(keepends=True)
        start = sum(map(len, lines[: self.line - 1])) + self.column
        text, before = b"".join(lines), self.before.encode()
        assert text[start : start + len(before)] == before, self
        path.write_bytes(text[:start] + self.after.encode() + text[start + len(before) :])


def mutants(path: Path) -> list[Mutant]:
    """All mutants of a file's functions, in the order of its lines."""
    source = path.read_text(encoding="utf-8")
    found = {
        Mutant(
            path.relative_to(ROOT).as_posix(),
            node.lineno,
            node.col_offset,
            ast.get_source_segment(source, node) or "",
            f"({ast.unparse(changed)})",
        )
        for node, changed in _changes(ast.parse(source))
    }
    return sorted(found, key=lambda one: (one.line, one.column, one.after))


def _changes(tree: ast.Module) -> Iterator[tuple[ast.expr, ast.expr]]:
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in function.body:
                for node in _expressions(statement):
                    yield from ((node, changed) for changed in _changed(node))


def _expressions(node: ast.AST) -> Iterator[ast.expr]:
    """Expressions below a node, without annotations, texts and what raises an error."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.FunctionDef | ast.AsyncFunctionDef):
        return
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if name in ("annotation", "returns") or not isinstance(child, ast.AST):
                continue
            if isinstance(child, ast.expr):
                yield child
            yield from _expressions(child)


def _changed(node: ast.expr) -> Iterator[ast.expr]:
    match node:
        case ast.Compare(ops=[operator]) if type(operator) in _SWAPS:
            yield _with(node, ops=[_SWAPS[type(operator)]()])
        case ast.BinOp(op=operator) if type(operator) in _SWAPS and not _is_text(node):
            yield _with(node, op=_SWAPS[type(operator)]())
        case ast.BoolOp(op=operator):
            yield _with(node, op=_SWAPS[type(operator)]())
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.IfExp(test=test):
            yield _with(node, test=ast.UnaryOp(ast.Not(), test))
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)):
            yield ast.Constant(2 * value + 1)


def _with(node: ast.expr, **fields: object) -> ast.expr:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _is_text(node: ast.BinOp) -> bool:
    """Whether an operand is text: another operator is then no fault that anybody makes."""
    return any(
        isinstance(one, ast.JoinedStr)
        or (isinstance(one, ast.Constant) and isinstance(one.value, str))
        for one in (node.left, node.right)
    )


def drawn(package: str, count: int) -> list[Mutant]:
    """Draw ``count`` mutants of a package by the seed."""
    files = sorted((ROOT / package).rglob("*.py"))
    return random.Random(SEED).sample([one for path in files for one in mutants(path)], count)


@cache
def measured(path: Path) -> CoverageData:
    """Read the record of which tests cover which line."""
    data = CoverageData(str(path))
    data.read()
    return data


def covering(data: CoverageData, mutant: Mutant) -> list[str]:
    """The tests that cover a mutant's line; those first that cover the fewest files."""
    contexts = data.contexts_by_lineno(str(ROOT / mutant.path)).get(mutant.line, [])
    tests = {_test_of(context) for context in contexts if context}
    return sorted(tests, key=lambda test: (_breadths(data)[test], test))


@cache
def _breadths(data: CoverageData) -> Counter[str]:
    """How many files each test covers."""
    breadths: Counter[str] = Counter()
    for path in data.measured_files():
        lines = data.contexts_by_lineno(path).values()
        breadths.update({_test_of(one) for contexts in lines for one in contexts})
    return breadths


def _test_of(context: str) -> str:
    """The id of a test; a process that it started has another context than the test."""
    return re.sub(r"(\|| \()(setup|run|call|teardown)\)?$", "", context)


def killer(tests: list[str], copied: Path, workers: int) -> str | None:
    """The test that fails in a copy of the repository; None if all pass."""
    listed = copied / "tests-of-a-mutant"
    listed.write_text("\n".join(tests), encoding="utf-8")
    arguments = ["-m", "pytest", "-x", "-q", "-rfE", "--tb=no", "-p", "no:cacheprovider"]
    arguments += ["-m", "not full"]
    if workers > 1 and len(tests) > 20:
        arguments += ["-n", str(workers), "--dist", "loadgroup"]
    environment = os.environ | {
        "PYTHONPATH": str(copied),
        "HELIOTWIN_STJ": str(data_folder().resolve()),
    }
    try:
        done = subprocess.run(
            [sys.executable, *arguments, f"@{listed}"],
            cwd=copied,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=TIME_LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return "the time limit"
    if done.returncode in (0, 5):  # 5: none is quick
        return None
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failed[0].split()[1] if failed else "the import"


def judge(mutant: Mutant, tests: list[str], copied: Path, workers: int) -> str | None:
    """The test that fails with a mutant and passes without it; None if there is none."""
    original = (copied / mutant.path).read_bytes()
    while tests:
        mutant.write(copied)
        try:
            found = killer(tests, copied, workers)
        finally:
            (copied / mutant.path).write_bytes(original)
        if found not in tests or killer([found], copied, 1) is None:
            return found
        tests = [test for test in tests if test != found]
    return None


def main(arguments: list[str] | None = None) -> int:
    """Print each mutant with the test that found it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20, help="mutants of each package")
    parser.add_argument("--coverage", type=Path, default=ROOT / ".coverage")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--packages", nargs="+", default=PACKAGES, choices=PACKAGES)
    options = parser.parse_args(arguments)
    data = measured(options.coverage)
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "copied"
        shutil.copytree(ROOT, copied, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
        for package in options.packages:
            n_killed = 0
            for mutant in drawn(package, options.count):
                tests = covering(data, mutant)
                found = judge(mutant, tests, copied, options.workers) if tests else None
                n_killed += found is not None
                verdict = f"killed by {found}" if found else f"survived {len(tests)} tests"
                print(f"{mutant}: {verdict}", flush=True)
            print(f"{package}: {n_killed} of {options.count} killed", flush=True)
            log_row(
                "Mutants that the quick tests find",
                package,
                {"killed [%]": proportion(n_killed, options.count, goal=">= 85")},
                n=options.count,
                of="mutants",
            )
    return 0


if __name__ == "__main__":
    with recording("mutants"):
        status = main()
    sys.exit(status)
