"""The site: Sphinx with MyST notebooks, built without network.

Nothing is fetched, neither at build nor by a reader's browser: the theme, its fonts and
the search lie in the package of the theme, and formulas become MathML.
"""

import os
import sys
from ctypes.util import find_library
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]
# Notebooks start a process each: one thread there, and the checkout's own package.
os.environ["PYTHONPATH"] = os.pathsep.join(
    filter(None, [str(HERE.parent), os.environ.get("PYTHONPATH")])
)
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Pictures of MuJoCo without a display; naming EGL where it is not breaks the import.
if not os.environ.get("DISPLAY") and find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

project = "sbi-active"
author = "The sbi-active developers"
copyright = "The sbi-active developers"
version = release = version_of("sbi-active")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_design",
    "sphinx_copybutton",
    "mathml",
    "outside",
    "reference",
    "results",
]
exclude_patterns = ["_build", "_ext", "conf.py", "**/__pycache__", "**/README*"]
templates_path = ["_templates"]
master_doc = "index"

# Pages and notebooks.
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 4
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / "notebooks")
nb_execution_in_temp = True
nb_execution_timeout = 900  # s; a cell takes seconds, on a busy machine minutes
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True
nb_output_stderr = "remove"  # paths of the machine that built the site
nb_ipywidgets_js = {}  # would be fetched by the reader's browser
nb_mime_priority_overrides = [("html", "text/plain", 50)]

# Reference.
autodoc_typehints = "none"  # signatures have names and defaults; docstrings the rest
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
add_module_names = False
toc_object_entries_show_parents = "hide"

# Appearance.
html_theme = "pydata_sphinx_theme"
html_title = "sbi-active"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": True,
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
    "footer_start": ["copyright"],
    "footer_end": ["sphinx-version"],
}
# Pages without others below them have nothing to navigate in a section.
ALONE = ("start", "overview", "architecture", "bibliography", "changelog")
html_sidebars: dict[str, list[str]] = {page: [] for page in ALONE}
html_context = {"default_mode": "auto"}
copybutton_exclude = ".linenos, .gp, .go"
