"""What the README says is so: its Python runs, its commands, pages, variants and sentences exist."""

import re
import subprocess
import sys

import pytest

from semiparam_ros.cli.main import COMMANDS
from semiparam_ros.core.variants import VARIANTS


@pytest.fixture(scope='module')
def readme(repository):
    return (repository / 'README.md').read_text(encoding='utf-8')


def blocks(text, language):
    return re.findall(rf'^```{language}\n(.*?)^```', text, re.MULTILINE | re.DOTALL)


def first_column(text, heading):
    """The words in code style that begin the rows of the first table below a heading."""
    section = text.split(f'\n## {heading}\n')[1].split('\n## ')[0]
    return re.findall(r'^\| `([^`]+)`', section, re.MULTILINE)


def test_every_python_block_runs(readme, repository):
    for block in blocks(readme, 'python'):
        done = subprocess.run([sys.executable, '-c', block], cwd=repository, capture_output=True, text=True,
                              timeout=250)
        assert done.returncode == 0, done.stderr
        assert 'nan' not in done.stdout


def test_the_table_of_commands_is_complete(readme):
    assert sorted(first_column(readme, 'Commands')) == sorted(COMMANDS)


def test_the_table_of_variants_is_complete(readme):
    assert sorted(first_column(readme, 'Variants')) == sorted(VARIANTS)


def test_every_option_in_a_shown_command_exists(readme):
    shown = re.findall(r'^    semiparam (\w+) (.*)$', readme, re.MULTILINE)
    assert shown
    for command, arguments in shown:
        wanted = set(re.findall(r'--[a-z-]+', arguments))
        answer = subprocess.run([sys.executable, '-m', 'semiparam_ros.cli.main', command, '--help'],
                                capture_output=True, text=True, timeout=60).stdout
        assert wanted <= set(re.findall(r'--[a-z-]+', answer)), (command, arguments)


@pytest.mark.parametrize('page', ['README.md', 'docs/mathematics.md', 'docs/architecture.md'])
def test_links_lead_somewhere(repository, page):
    source = repository / page
    for target in re.findall(r'\]\(([^)]+)\)', source.read_text(encoding='utf-8')):
        if '://' in target:
            continue
        path, _, anchor = target.partition('#')
        linked = source.parent / path if path else source
        assert linked.exists(), target
        assert not anchor or anchor in anchors(linked.read_text(encoding='utf-8')), target


def anchors(text):
    """As GitHub makes them from headings."""
    headings = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_paths_that_pages_name_exist(repository):
    for page in ('README.md', 'docs/mathematics.md', 'docs/architecture.md'):
        text = (repository / page).read_text(encoding='utf-8')
        for path in re.findall(r'`((?:test|docs|config|bags|core|effects|settings|cli)/[\w./]+\.\w+)`', text):
            assert (repository / path).exists() or (repository / 'semiparam_ros' / path).exists(), (page, path)
