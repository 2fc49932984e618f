"""Links that leave the site: to other projects' names, and to files of this one.

An inventory of another project would have to be fetched. The few names that the
docstrings use stand in ``outside.txt`` instead, a name and an address a line.
"""

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

NAMES = Path(__file__).parent / "outside.txt"


def _names() -> dict[str, str]:
    lines = NAMES.read_text(encoding="utf-8").splitlines()
    return dict(line.split() for line in lines if line and not line.startswith("#"))


def _resolve(app: Sphinx, env: Any, node: Any, content: nodes.Node) -> Any:
    address = _names().get(node.get("reftarget", "").lstrip("."))
    if node.get("refdomain") != "py" or address is None:
        return None
    link = nodes.reference("", "", internal=False, refuri=address)
    link += content
    return link


def setup(app: Sphinx) -> dict[str, bool]:
    """Answer where no name of the site does."""
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
