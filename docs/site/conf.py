"""Settings of Sphinx for the pages that scripts/build_site.py has collected."""

import sys
from pathlib import Path

import stcal

sys.path.insert(0, str(Path(__file__).resolve().parent))

project = "stcal"
author = "The stcal contributors"
project_copyright = author
version = release = stcal.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "docstrings"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
highlight_language = "none"
smartquotes = False
suppress_warnings = ["misc.highlighting_failure"]  # examples with "…" in them

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
nitpicky = True
# Types and names in docstrings that are not of the public interface have no page; links of pages are all followed.
nitpick_ignore_regex = [(r"py:.*", r".*")]

html_theme = "furo"
html_title = f"stcal {version}"
html_static_path = ["static"]
html_css_files = ["wide.css"]
html_theme_options = {"navigation_with_keys": True}
html_copy_source = False
html_show_sphinx = False
