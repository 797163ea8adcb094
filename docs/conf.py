"""The documentation as a site: `make docs`. Every page is also readable as a plain file."""

from semiparam_ros import __version__

project = 'semiparam_ros'
author = 'semiparam_ros maintainers'
copyright = 'semiparam_ros maintainers, Apache-2.0'
release = version = __version__

extensions = ['myst_parser', 'sphinx.ext.autodoc']
source_suffix = {'.md': 'markdown'}
exclude_patterns = ['_build']

myst_heading_anchors = 4
myst_enable_extensions = ['deflist']
# A block that shows a page's source or a formula is no program.
highlight_language = 'none'
# Two dashes begin an option.
smartquotes = False

html_theme = 'furo'
html_title = f'semiparam_ros {version}'
html_static_path = ['_static']
html_css_files = ['tables.css']
html_copy_source = False

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
# Types of other packages are named in signatures; their documentation is not fetched.
nitpick_ignore_regex = [('py:.*', r'(?!semiparam_ros\.).*')]
