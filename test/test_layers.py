"""Dependencies point one way only, and every room says what it is."""

import ast
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from semiparam_ros.effects import kinds

PACKAGE = Path(__file__).resolve().parents[1] / 'semiparam_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))

OPEN_TO_ALL = {'errors', 'atomic_write'}
NUMBERS = {*OPEN_TO_ALL, 'core', 'effects', 'diagnosis'}
OFFLINE = {*NUMBERS, 'settings', 'bags', 'online', 'experiments', 'simulation'}
ANYTHING = {*OFFLINE, 'interrupts', 'export', 'playback', 'report', 'ros', 'cli'}

# What each layer may know of the package besides itself.
MAY_IMPORT = {
    'errors': set(),
    'atomic_write': {'errors'},
    'interrupts': set(),
    'core': {'errors'},
    'effects': {'errors', 'core'},
    'diagnosis': {'errors', 'core', 'effects'},
    # Shares nothing with what is tested against it: array types are no knowledge.
    'simulation': {'errors', 'core.types'},
    'settings': {*OPEN_TO_ALL, 'core', 'effects'},
    'bags': {*OPEN_TO_ALL, 'core', 'settings'},
    'online': {*NUMBERS, 'settings', 'bags'},
    'export': {*OPEN_TO_ALL, 'core', 'effects'},
    'playback': {*OPEN_TO_ALL, 'core', 'bags'},
    'experiments': OFFLINE,
    'report': OFFLINE,
    'ros': {*NUMBERS, 'settings', 'bags', 'online', 'playback', 'export', 'interrupts'},
    'cli': ANYTHING,
}

# The numbers know no ROS, no bag format and no terminal.
NUMERIC = ('core', 'effects', 'diagnosis', 'simulation')
NUMERIC_MAY_IMPORT = {'numba', 'numpy', 'scipy', 'pinocchio', 'sklearn'}
ONLY_ROS = {'rclpy', 'rcl_interfaces', 'sensor_msgs', 'geometry_msgs', 'std_msgs', 'std_srvs', 'trajectory_msgs',
            'diagnostic_msgs', 'rosgraph_msgs', 'builtin_interfaces'}


@cache
def nodes(path: Path) -> list[ast.AST]:
    """Everything in the syntax of a module."""
    return [*ast.walk(ast.parse(path.read_text(encoding='utf-8')))]


@cache
def imports(path: Path) -> set[str]:
    """Dotted names of everything a module imports, at its top or inside its functions."""
    found: set[str] = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path} imports relatively, which hides its layer'
            found.add(node.module)
            found.update(f'{node.module}.{alias.name}' for alias in node.names)
    return found


def layer(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix('.py')


def offences(path: Path) -> list[str]:
    """The package's own modules that this one must not know."""
    mine = layer(path)
    if mine == '__init__':
        return []
    allowed = {f'semiparam_ros.{name}' for name in MAY_IMPORT[mine] | {mine}} | {'semiparam_ros.__version__'}
    inside = {name for name in imports(path) if name.startswith('semiparam_ros.')}
    return sorted(name for name in inside
                  if not any(name == start or name.startswith(f'{start}.') for start in allowed)
                  # `from semiparam_ros.core import types`: the parent itself names no module.
                  and not any(start.startswith(f'{name}.') for start in allowed))


def within(*layers: str) -> list[Path]:
    return [path for path in MODULES if layer(path) in layers]


def libraries(path: Path) -> set[str]:
    """Packages that a module imports."""
    return {name.split('.')[0] for name in imports(path)}


def test_every_layer_has_a_rule():
    assert {layer(path) for path in MODULES} <= {*MAY_IMPORT, '__init__'}


def test_dependencies_point_one_way():
    for path in MODULES:
        assert offences(path) == [], path


def test_numbers_need_numeric_libraries_alone():
    for path in within(*NUMERIC):
        assert libraries(path) <= {'semiparam_ros', *sys.stdlib_module_names, *NUMERIC_MAY_IMPORT}, path


def test_offline_parts_run_without_ros():
    for path in within('settings', 'bags', 'online', 'export', 'playback', 'experiments', 'report'):
        assert not libraries(path) & ONLY_ROS, path


def test_every_room_says_what_it_is():
    for path in PACKAGE.rglob('__init__.py'):
        docstring = ast.get_docstring(nodes(path)[0]) or ''
        assert docstring.split('\n\n')[0].endswith('.'), path


def rooms(path: Path) -> set[str]:
    """Folders and single modules of the diagnosis that a module of it imports."""
    inside = [name.split('.')[2:] for name in imports(path) if name.startswith('semiparam_ros.diagnosis.')]
    return {parts[0] for parts in inside if parts}


def test_no_folder_of_the_diagnosis_leads_back_to_itself():
    known: dict[str, set[str]] = {}
    for path in within('diagnosis'):
        parts = path.relative_to(PACKAGE / 'diagnosis').parts
        known.setdefault(parts[0].removesuffix('.py'), set()).update(rooms(path))
    order = TopologicalSorter({room: beneath - {room} for room, beneath in known.items()})
    assert list(order.static_order())


def test_no_kind_is_named_outside_the_effects():
    names = {name for name in kinds() if '_' in name}
    for path in within('diagnosis'):
        texts = {node.value for node in nodes(path) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
        assert not texts & names, path


DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
NO_NOUN_OR_VERB = {'as', 'how', 'is', 'of', 'that', 'those', 'what', 'where', 'whether', 'which'}


def test_docstrings_begin_with_a_noun_or_a_verb():
    for path in MODULES:
        documented = [node for node in nodes(path) if isinstance(node, DOCUMENTED)]
        first = {(ast.get_docstring(node) or 'none').split()[0].lower() for node in documented}
        assert not first & NO_NOUN_OR_VERB, path


def test_no_class_name_stands_twice():
    classes = [node.name for path in MODULES for node in nodes(path) if isinstance(node, ast.ClassDef)]
    assert sorted(classes) == sorted(set(classes))


def test_the_rule_catches_an_upward_import(tmp_path, monkeypatch):
    module = tmp_path / 'core' / 'wrong.py'
    module.parent.mkdir()
    module.write_text('def later():\n    from semiparam_ros.effects import registry\n')
    monkeypatch.setitem(globals(), 'PACKAGE', tmp_path)
    assert offences(module) == ['semiparam_ros.effects', 'semiparam_ros.effects.registry']
