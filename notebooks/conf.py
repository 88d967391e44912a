"""How the documentation is built: `sphinx-build -W -b html notebooks build/docs`."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import vcal  # noqa: E402

project = "vcal"
author = "The vcal developers"
copyright = "The vcal developers"
version = release = vcal.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "_site.mathml",
]
exclude_patterns = ["_site", "**/.ipynb_checkpoints", "README.md"]

myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["toc.not_included"]
nb_execution_mode = "off"
html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"vcal {version}"
