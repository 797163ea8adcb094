"""A page in a real browser, what its console says, and whether it needs nothing else."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
# As root, and where only this machine can be reached.
FLAGS = ['--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync', '--hide-scrollbars',
         '--window-size=1000,1200', '--enable-logging=stderr']


def unavailable(reason):
    """What some tests need is missing; where CI=true it must be there."""
    if os.environ.get('CI', '').lower() == 'true':
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture
def browse(tmp_path):
    """Opens a page and returns its document after loading, and what the console said."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        unavailable(f'no browser to open the page with: none of {", ".join(BROWSERS)} is installed')

    def run(text, *flags):
        path = tmp_path / 'page.html'
        path.write_text(text, encoding='utf-8')
        done = subprocess.run([found, *FLAGS, f'--user-data-dir={tmp_path / "profile"}', *flags, path.as_uri()],
                              capture_output=True, text=True, timeout=120, check=True)
        return done.stdout, [line for line in done.stderr.splitlines() if 'CONSOLE' in line]
    return run


def is_dark(browse, text, shot, *flags):
    """Whether a page that has something on it is dark."""
    from matplotlib import image

    browse(text, *flags, f'--screenshot={shot}')
    pixels = image.imread(shot)[..., :3]
    assert pixels.std() > 0.05
    return float(np.median(pixels)) < 0.3


def check_that_it_stands_alone(text):
    """Nothing is fetched or run, and each reference within the page is met by one place in it."""
    addresses = re.findall(r'(?:src|href)="([^"]*)"', text) + re.findall(r'url\(([^)]*)\)', text)
    assert all(address.startswith(('#', 'data:')) for address in addresses), addresses
    assert '<script' not in text
    defined = re.findall(r'\bid="([^"]*)"', text)
    assert len(defined) == len(set(defined))
    assert set() < set(re.findall(r'(?:href="|url\()#([^")]*)', text)) <= set(defined)
