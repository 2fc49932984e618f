"""The rooms: what they hold, and that imports point one way."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest
import tomllib

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT / "sbi_active"
MOST_FILES = 14  # of a room
MOST_LINES = 400  # of a file

#: From the ground up. A room, or a file that lives on another floor than its room,
#: imports from its own floor and from those before it; never from a later one.
FLOORS = (
    "callers",
    "messages",
    "renamed",
    "seeding",
    "support",
    "threads",
    "display",
    "progress",
    "arviz_versions",
    "arrays",
    "actions",
    "combinations",
    "simulation.noise",
    "simulation",
    "simulation.workers",
    "simulation.check",
    "simulation.bank",
    "inference.sampling",
    "inference.beliefs",
    "inference.rounds",
    "inference.regression",
    "inference.engine",
    "inference.declared",
    "inference.refinement",
    "inference.emulation",
    "inference.products",
    "inference.networks",
    "inference.models",
    "inference.trainers",
    "pyro",
    "information_gain",
    "information_gain.fits",
    "information_gain.estimators",
    "search",
    "design",
    "diagnostics",
    "criticism.contradictions",
    "criticism.under_misfit",
    "criticism.results",
    "criticism.data",
    "criticism.effects",
    "criticism.rivals",
    "criticism.forces",
    "criticism.evidence",
    "criticism.steps",
    "criticism.linear",
    "criticism.misfit",
    "criticism.next_trial",
    "criticism.report",
    "criticism",
    "criticism.identification",
    "mujoco.models",
    "mujoco",
    "mujoco.effects",
    "mujoco.identification",
    "campaign.stopping",
    "campaign.display.html",
    "campaign.options",
    "campaign.state",
    "campaign.spending",
    "campaign.checks",
    "campaign.display",
    "campaign.isolation",
    "campaign.learning",
    "campaign.telling",
    "campaign.storage",
    "campaign",
    "migration",
    "export",
    "plots",
    "tasks",
    "cli",
)


def module_of(path: Path) -> str:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix(".__init__")


@cache
def modules() -> dict[str, Path]:
    """Every module of the library by its name; those of tasks are not part of it."""
    paths = [p for p in LIBRARY.rglob("*.py") if "tasks" not in p.parts]
    return {module_of(path): path for path in sorted(paths)}


def imported(path: Path) -> set[tuple[str, str]]:
    """Pairs (module, name) that a file imports, within types and functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {(node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names}
    return {pair for pair in found if pair[0].split(".")[0] == "sbi_active"}


@cache
def definition(module: str, name: str) -> str:
    """The module behind a name that a room re-exports."""
    if module.startswith("sbi_active.tasks"):
        return "sbi_active.tasks"
    if f"{module}.{name}" in modules():
        return f"{module}.{name}"
    path = modules().get(module)
    if path is not None and path.name == "__init__.py":
        for source, exported in imported(path):
            if exported == name:
                return definition(source, name)
    return module


@cache
def graph() -> dict[str, set[str]]:
    """The files that each file imports from; ``__init__`` are doors and no files."""
    return {
        module: {definition(*pair) for pair in imported(path)} - {module}
        for module, path in modules().items()
        if path.name != "__init__.py"
    }


def floor(module: str) -> int:
    """The floor of a file: its own, or that of its room."""
    parts = module.split(".")[1:]
    for k in range(len(parts), 0, -1):
        if ".".join(parts[:k]) in FLOORS:
            return FLOORS.index(".".join(parts[:k]))
    raise AssertionError(f"expected {module} on a floor; got none; add its room")


def circles(edges: dict[str, set[str]]) -> list[set[str]]:
    """Groups that import each other in a circle (Tarjan, SIAM J. Comput. 1972)."""
    order, low, stack, found = {}, {}, [], []

    def visit(v: str) -> None:
        order[v] = low[v] = len(order)
        stack.append(v)
        for w in sorted(edges.get(v, ())):
            if w not in order:
                visit(w)
            if w in stack:
                low[v] = min(low[v], low[w])
        if low[v] == order[v]:
            at = stack.index(v)
            group = set(stack[at:])
            del stack[at:]
            if len(group) > 1:
                found.append(group)

    for v in sorted(edges):
        if v not in order:
            visit(v)
    return found


def test_imports_point_down():
    up = [
        f"{module} imports {other}"
        for module, others in graph().items()
        for other in sorted(others)
        if other != "sbi_active" and floor(other) > floor(module)
    ]
    assert not up


def test_no_files_import_each_other_in_a_circle():
    assert not circles(graph())


def test_a_circle_and_a_step_up_are_found():
    edges = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}
    assert circles(edges) == [{"a", "b", "c"}]
    assert floor("sbi_active.campaign.state") < floor("sbi_active.campaign.campaign")


@pytest.mark.parametrize(
    "room", sorted({path.parent for path in modules().values()}), ids=module_of
)
def test_a_room_is_small_and_says_what_it_is_for(room: Path):
    files = [p for p in room.glob("*.py") if p.name != "__init__.py"]
    assert len(files) <= MOST_FILES
    for file in files:
        assert len(file.read_text().splitlines()) <= MOST_LINES, file
    door = ast.get_docstring(ast.parse((room / "__init__.py").read_text())) or ""
    assert len(door.split()) > 12, "expected what may live in the room, and what not"


def test_every_room_is_installed():
    with (ROOT / "pyproject.toml").open("rb") as file:
        packages = tomllib.load(file)["tool"]["setuptools"]["packages"]
    rooms = {m for m, path in modules().items() if path.name == "__init__.py"}
    assert rooms == {p for p in packages if not p.startswith("sbi_active.tasks")}
