"""How many small faults of the code its tests notice.

    python benchmarks/mutations.py --count 48 --seed 1 --json output/mutations.json

Draws small faults (a comparison turned or made strict, + for -, another number, a condition negated, a statement left
out) in packages of ``semiparam_ros``, as many from each, puts one at a time into a copy of the checkout, and runs the
tests of that package there until one fails, for at most --processor-s. A fault that no test notices has survived.
"""

import argparse
import ast
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = 'core', 'effects', 'online', 'diagnosis'
OTHER = {ast.Lt: '<=', ast.LtE: '<', ast.Gt: '>=', ast.GtE: '>', ast.Eq: '!=', ast.NotEq: '==', ast.Is: 'is not',
         ast.IsNot: 'is', ast.In: 'not in', ast.NotIn: 'in', ast.Add: '-', ast.Sub: '+', ast.Mult: '/', ast.Div: '*',
         ast.And: 'or', ast.Or: 'and'}


def faults(path: Path) -> list[tuple[int, int, int, str]]:
    """(line, start, end, what stands there instead) of every fault within the functions of a file, in one line each."""
    text = path.read_text(encoding='utf-8')
    lines = text.encode().split(b'\n')
    nodes = (node for function in ast.walk(ast.parse(text)) if isinstance(function, ast.FunctionDef)
             for statement in function.body for node in ast.walk(statement)
             if getattr(node, 'lineno', 0) == getattr(node, 'end_lineno', -1))
    return sorted({(node.lineno, *fault) for node in nodes for fault in faults_of(node, lines[node.lineno - 1])})


def faults_of(node: ast.AST, line: bytes) -> list[tuple[int, int, str]]:
    """(start, end, text) in bytes of its line."""
    if isinstance(node, ast.Compare | ast.BinOp | ast.BoolOp):
        if isinstance(node, ast.Compare):
            left, operator, right = node.left, node.ops[0], node.comparators[0]
        elif isinstance(node, ast.BinOp):
            left, operator, right = node.left, node.op, node.right
        else:
            (left, right), operator = node.values[:2], node.op
        if type(operator) in OTHER:
            between = line[left.end_col_offset:right.col_offset].decode()
            other = f'{")" * between.count(")")} {OTHER[type(operator)]} {"(" * between.count("(")}'
            return [(left.end_col_offset, right.col_offset, other)]
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        other = node.value + 1 if isinstance(node.value, int) else 2.0 * node.value or 1.0
        return [(node.col_offset, node.end_col_offset, repr(other))]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return [(node.col_offset, node.operand.col_offset, '')]
    if isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        return [(node.col_offset, node.end_col_offset, 'pass')]
    return []


def draw(packages: list[str], count: int, seed: int) -> list[tuple[Path, tuple[int, int, int, str]]]:
    """The same for the same code."""
    found = []
    for package in packages:
        files = sorted((REPOSITORY / 'semiparam_ros' / package).rglob('*.py'))
        everything = [(path.relative_to(REPOSITORY), fault) for path in files for fault in faults(path)]
        found += random.Random(f'{seed} {package}').sample(everything, count // len(packages))
    return found


def tests_of(copy: Path, module: Path) -> list[str]:
    """The files of its package's tests; first those that name the module, then the small ones."""
    files = (copy / 'test' / module.parts[1]).glob('test_*.py')
    return sorted(map(str, files), key=lambda file: (
        f'{module.stem} ' not in Path(file).read_text(encoding='utf-8'), Path(file).stat().st_size))


def outcome(copy: Path, module: Path, fault: tuple[int, int, int, str], processor_s: int) -> dict[str, object]:
    """What the tests say of one fault."""
    original = (copy / module).read_bytes()
    line, start, end, text = fault
    lines = original.split(b'\n')
    before = lines[line - 1]
    lines[line - 1] = before[:start] + text.encode() + before[end:]
    (copy / module).write_bytes(b'\n'.join(lines))
    ended = subprocess.run(
        [sys.executable, '-m', 'pytest', '-x', '-q', '--hypothesis-seed=0', *tests_of(copy, module)], cwd=copy,
        env=os.environ | {'PYTHONPATH': str(copy)}, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (processor_s, processor_s)))
    failed = [row[:160] for row in ended.stdout.splitlines() if row.startswith(('FAILED', 'ERROR'))]
    failed += [ended.stdout[-160:]] if ended.returncode > 0 else ['']
    (copy / module).write_bytes(original)
    return {'file': str(module), 'line': line, 'before': before.decode().strip(),
            'after': lines[line - 1].decode().strip(), 'noticed': failed[0], 'in_time': ended.returncode >= 0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('packages', nargs='*', default=[*PACKAGES])
    parser.add_argument('--count', type=int, default=48)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--processor-s', type=int, default=40)
    parser.add_argument('--json', type=Path, required=True)
    options = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / 'copy'
        (Path(folder) / 'shared').symlink_to((REPOSITORY.parent / 'shared').resolve())
        shutil.copytree(REPOSITORY, copy, ignore=shutil.ignore_patterns('.git', '.venv', 'output', '.hypothesis'))
        for module, fault in draw(options.packages, options.count, options.seed):
            found.append(outcome(copy, module, fault, options.processor_s))
            print(json.dumps(found[-1]), flush=True)
            options.json.write_text(json.dumps(found, indent=1) + '\n', encoding='utf-8')
    print(f"{sum(bool(one['noticed']) for one in found)} of {len(found)} faults were noticed")


if __name__ == '__main__':
    main()
