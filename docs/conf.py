"""The site: Sphinx, MyST for the Markdown, Furo for the looks.  `make docs` builds it and checks its links.

Nothing is fetched when a page is looked at: no fonts, scripts or styles from elsewhere.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "machinery"))

from factorbus.proto.version import __version__

project = "factorbus"
author = "The factorbus developers"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "borrowed", "equations", "docstrings", "helped"]
exclude_patterns = ["machinery", "notebooks/*.py"]

html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["pages.css"]
html_title = f"factorbus {release}"
html_copy_source = False
html_show_sourcelink = False

myst_heading_anchors = 4
toc_object_entries = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Key": "Key"}  # one word in a signature, not what they stand for
autodoc_default_options = {"members": True, "undoc-members": True}
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
