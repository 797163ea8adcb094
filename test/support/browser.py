"""A page in a real browser, and what its console says."""

import os
import shutil
import subprocess

import pytest

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
# As root, and where only this machine can be reached.
FLAGS = ['--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync', '--hide-scrollbars',
         '--window-size=1000,1200', '--enable-logging=stderr']


@pytest.fixture
def browse(tmp_path):
    """Opens a page and returns its document after loading, and what the console said."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        sentence = f'no browser to open the page with: none of {", ".join(BROWSERS)} is installed'
        if os.environ.get('CI', '').lower() == 'true':
            pytest.fail(sentence)
        pytest.skip(sentence)

    def run(text, *flags):
        path = tmp_path / 'page.html'
        path.write_text(text, encoding='utf-8')
        done = subprocess.run([found, *FLAGS, f'--user-data-dir={tmp_path / "profile"}', *flags, path.as_uri()],
                              capture_output=True, text=True, timeout=120, check=True)
        return done.stdout, [line for line in done.stderr.splitlines() if 'CONSOLE' in line]
    return run
