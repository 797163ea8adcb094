"""What the README and the documentation say is so: every block runs, every link leads somewhere, every message exists.

``doc_blocks`` says how a block is run, and how one that cannot run says so on the page.
"""

import ast
import re
import runpy
from pathlib import Path

import pytest

from semiparam_ros.cli.main import COMMANDS
from semiparam_ros.core.variants import CHOICES
from semiparam_ros.effects.registry import BUILT_IN
from semiparam_ros.settings.parameter_table import BY_NAME
from support.doc_blocks import RUN, SHOWN, WRITTEN, Workshop, blocks, check_parses, commands

REPOSITORY = Path(__file__).resolve().parents[1]
# Those with a program in the background last: what stands on another page too is known by then.
LOG = sorted((REPOSITORY / 'docs/log').glob('2*.md'))
"""The laboratory book: its commands and figures are those of the code of their day."""
PAGES = sorted([REPOSITORY / 'README.md', REPOSITORY / 'CONTRIBUTING.md',
                *sorted({*(REPOSITORY / 'docs').rglob('*.md')} - {*LOG})],
               key=lambda page: '\n# terminal 1' in page.read_text(encoding='utf-8'))
NAMES = [str(page.relative_to(REPOSITORY)) for page in PAGES]
PARSED = {'benchmarks.md', 'measurements.md', 'comparison.md', 'robustness.md', 'replay.md', 'ros_interface.md',
          'node.md', 'diagnosis.md'}
"""Pages of reference, whose commands take minutes or name files of yours: they are parsed."""
LONG = {'temperature.md', 'changes.md', 'export.md', 'efforts.md', 'json.md', 'plot.md', 'save_and_load.md',
        'switch_variants.md', 'outside_forces.md', '1_replay.md', '3_close_the_loop.md'}
"""Pages whose commands other pages or tests run with other recordings: they are parsed, and run in the long form."""
LONGEST = 35
"""Words of a sentence."""
UNTESTED = 33
"""Blocks that need what no test has. A new one is a decision: count it here."""


@pytest.fixture(scope='module')
def known():
    """What blocks have made, by their text: none is run twice."""
    return {}


@pytest.fixture
def workshop(tmp_path, known, ros_domain):
    with Workshop(tmp_path / 'page', REPOSITORY, known) as workshop:
        yield workshop


@pytest.mark.slow
@pytest.mark.parametrize('page', PAGES, ids=NAMES)
def test_every_block_of_a_page_runs(page, workshop, long):
    parsed = page.name in PARSED or (page.name in LONG and not long)
    for block in blocks(page):
        if block.language == 'python':
            compile(block.text, str(block), 'exec')
        if block.special == 'not tested' or (page.name in LONG and parsed and block.language in ('text', 'python')):
            continue
        if (parsed and block.language == 'bash') or runs_make(block):
            check_parses(block, REPOSITORY)
        elif block.language in (*RUN, 'yaml') or block.special or follows_a_command(block):
            workshop.run(block)


def runs_make(block):
    """`make` builds an environment: the rules are looked at, and other tests run what they start."""
    return block.language == 'bash' and any(line.startswith('make ') for line in commands(block))


def follows_a_command(block):
    """Text directly behind a command, which is a part of what it prints."""
    around = blocks(next(page for page in PAGES if page.name == block.page))
    before = [other for other in around if other.line < block.line and other.special != 'file']
    return (block.language == 'text' and bool(before) and before[-1].language in (*RUN, 'text')
            and before[-1].special != 'not tested')


def test_every_block_is_of_a_known_kind():
    languages = {(block.page, block.line): block.language for page in PAGES for block in blocks(page)
                 if not block.language.startswith('{')}
    unknown = {place: language for place, language in languages.items()
               if language not in {*RUN, *WRITTEN, *SHOWN, 'yaml'}}
    assert not unknown


def test_blocks_that_are_not_tested_say_why_and_are_counted():
    left_out = [block for page in PAGES for block in blocks(page) if block.special == 'not tested']
    assert all(len(block.detail.split()) >= 2 for block in left_out)
    assert len(left_out) == UNTESTED


def test_ros2_commands_name_parameters_and_services_that_exist():
    reference = (REPOSITORY / 'docs/ros_interface.md').read_text(encoding='utf-8')
    text = '\n'.join(page.read_text(encoding='utf-8') for page in PAGES)
    services = re.findall(r'ros2 service call /estimator/(\w+)', text)
    assert services
    assert all(f'`~/{service}`' in reference for service in services)
    parameters = re.findall(r'ros2 param set /estimator (\S+)', text)
    assert parameters
    assert all(BY_NAME[name].live for name in parameters)


def test_what_is_made_from_the_code_is_up_to_date():
    """Commands, parameters and the file that holds them all, and the tables of effects."""
    files = runpy.run_path(str(REPOSITORY / 'docs/reference/render.py'))['files']()
    for path, text in files.items():
        assert path.read_text(encoding='utf-8') == text, 'run python docs/reference/render.py'
    assert all(f'## semiparam {command}\n' in files[REPOSITORY / 'docs/reference/commands.md'] for command in COMMANDS)


def test_the_table_of_variants_is_complete():
    page = (REPOSITORY / 'docs/concepts.md').read_text(encoding='utf-8')
    section = page.split('\n## Variants\n')[1].split('\n## ')[0]
    assert sorted(re.findall(r'^\| `([^`]+)`', section, re.MULTILINE)) == sorted(CHOICES)


def test_links_lead_somewhere():
    links = [(page, target) for page in (*PAGES, *LOG) for target in re.findall(r'\]\(([^)\s]+)\)', prose(page))]
    for page, target in links:
        if '://' in target:
            continue
        path, _, anchor = target.partition('#')
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), (page, target)
        assert not anchor or anchor in anchors(linked.read_text(encoding='utf-8')), (page, target)


def prose(page):
    """A page without its fenced blocks and its code in lines."""
    text = re.sub(r'^ *```.*?^ *```$', '', page.read_text(encoding='utf-8'), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r'`[^`\n]*`', '', text)


def anchors(text):
    """As GitHub makes them from headings."""
    text = re.sub(r'^ *```.*?^ *```$', '', text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_every_page_is_in_the_table_of_contents():
    contents = (REPOSITORY / 'docs/index.md').read_text(encoding='utf-8').splitlines()
    listed = [page for page in PAGES if page.parent != REPOSITORY and page.name != 'index.md']
    assert {str(page.relative_to(REPOSITORY / 'docs').with_suffix('')) for page in listed} <= {*contents}


def test_every_day_is_in_the_table_of_contents_of_the_log():
    contents = (REPOSITORY / 'docs/log/index.md').read_text(encoding='utf-8').splitlines()
    assert {page.stem for page in LOG} <= {*contents}


CHANGES = REPOSITORY / 'CHANGELOG.rst'


def test_no_sentence_is_long():
    sentences = [(page.name, sentence) for page in (*PAGES, CHANGES) for sentence in sentences_of(page)]
    assert [each for each in sentences if len(re.findall(r'\S*\w\S*', each[1])) > LONGEST] == []


def test_an_entry_of_the_changelog_is_one_line():
    """What changes for the user; how it came about is told by the commit, and figures by the log."""
    text = CHANGES.read_text(encoding='utf-8')
    versions = re.split(r'^\S+ \([\d-]+\)\n-+\n', text, flags=re.MULTILINE)
    newest = versions[1].splitlines()
    assert len(newest) > 10
    assert [line for line in newest if not re.fullmatch(r'\* .{1,98}|[A-Z][\w ]+:|', line)] == []


def sentences_of(page):
    """Of paragraphs and items of lists; code, tables, headings and formulas are none."""
    text = page.read_text(encoding='utf-8')
    text = re.sub(r'^ *```.*?^ *```$|<!--.*?-->', '', text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r'`+[^`]*`+', 'code', text)
    text = re.sub(r'!?\[([^]]*)\]\([^)]*\)', r'\1', text)
    text = re.sub(r'^(\||#| {4}\S).*$', '', text, flags=re.MULTILINE)
    paragraphs = re.split(r'\n\s*\n|^\s*(?:[-*:]|\d+\.) +', text, flags=re.MULTILINE)
    return [sentence for paragraph in paragraphs
            for sentence in re.split(r'(?<=[.!?])["*)]*\s+', paragraph)]


def test_the_tables_of_the_benchmarks_are_those_of_their_files():
    render = runpy.run_path(str(REPOSITORY / 'docs/figures/render.py'))
    page = ''.join(path.read_text(encoding='utf-8') for path in render['PAGES'])
    assert render['with_tables'](page) == page, 'run python docs/figures/render.py'
    named = re.findall(r'<!-- table (\w+): begin', page)
    files = {path.stem for path in (REPOSITORY / 'docs/figures').glob('*.json')}
    assert {render['MADE'].get(name, (name,))[0] for name in named} == {*files, 'sources'}


def test_paths_that_pages_name_exist():
    text = '\n'.join(page.read_text(encoding='utf-8') for page in PAGES)
    for path in re.findall(r'`((?:test|docs|config|bags|launch|core|effects|settings|cli|ros)/[\w./]+\.\w+)`', text):
        assert (REPOSITORY / path).exists() or (REPOSITORY / 'semiparam_ros' / path).exists(), path


@pytest.fixture(scope='module')
def sentences():
    """Every text in the package, with three points for what it fills in."""
    found = []
    for path in sorted((REPOSITORY / 'semiparam_ros').rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.JoinedStr):
                found.append(''.join(part.value if isinstance(part, ast.Constant) else '...' for part in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return '\n'.join(found)


@pytest.mark.parametrize('page', ['docs/troubleshooting.md', 'docs/how-to/diagnostics.md'])
def test_messages_are_those_of_the_package(page, sentences):
    text = (REPOSITORY / page).read_text(encoding='utf-8')
    quoted = re.findall(r'^\| `([^`|]+ [^`|]+)` \|', text, re.MULTILINE)
    quoted += re.findall(r'^\| \*\w+\*: "([^"]+)"', text, re.MULTILINE)
    ours = [message for message in quoted if not message.startswith('error: ')]
    assert ours
    for message in ours:
        fragments = [part.strip(" ',;:()") for part in message.split('...')]
        for fragment in (part for part in fragments if len(part) > 7):
            assert fragment in sentences, (message, fragment)


@pytest.mark.parametrize('page', ['README.md', 'docs/robustness.md'])
def test_as_many_kinds_of_effects_are_told_as_there_are(page):
    assert f' {len(BUILT_IN)} kinds' in (REPOSITORY / page).read_text(encoding='utf-8')
