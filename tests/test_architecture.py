"""The rooms: what they hold, and that imports point one way."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import tomllib

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT / "sbi_active"
MOST_FILES = 14  # of a room
MOST_LINES = 400  # of a file

#: Packages from the ground up; files beside them stand on the ground, but for those
#: named here. One imports from its own floor and from those before it, never from a
#: later one. Within a package, rooms import each other in no circle.
GROUND = "ground"
FLOORS = (
    GROUND,
    "actions",
    "identifiability",
    "simulation",
    "inference",
    "pyro",
    "design",
    "information_gain",
    "search",
    "diagnostics",
    "criticism",
    "mujoco",
    "campaign",
    "migration",
    "export",
    "tasks",
    "cli",
    "__main__",
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


def room_of(module: str) -> str:
    """The room of a file: a folder of a package, or itself where it stands in none."""
    return ".".join(module.split(".")[1:3])


def floor(module: str) -> int:
    """The floor of a file, that of its package."""
    package = module.split(".")[1]
    return FLOORS.index(package if package in FLOORS else GROUND)


def test_imports_point_down():
    up = [
        f"{module} imports {other}"
        for module, others in graph().items()
        for other in sorted(others)
        if other != "sbi_active" and floor(other) > floor(module)
    ]
    assert not up


def test_no_files_import_each_other_in_a_circle():
    TopologicalSorter(graph()).prepare()  # or its error names them


def test_no_rooms_import_each_other_in_a_circle():
    rooms: dict[str, set[str]] = {}
    for module, others in graph().items():
        own = rooms.setdefault(room_of(module), set())
        own |= {room_of(other) for other in others} - {room_of(module)}
    TopologicalSorter(rooms).prepare()


def test_a_circle_and_a_step_up_are_found():
    edges = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}
    with pytest.raises(CycleError):
        TopologicalSorter(edges).prepare()
    assert floor("sbi_active.seeding") < floor("sbi_active.campaign.campaign")
    assert room_of("sbi_active.inference.engine.infer") == "inference.engine"
    assert room_of("sbi_active.criticism.loop") == "criticism.loop"


@pytest.mark.parametrize(
    "room", sorted({path.parent for path in modules().values()}), ids=module_of
)
def test_a_room_is_small_and_says_what_it_is_for(room: Path):
    doors = ("__init__.py", "__main__.py")
    files = [p for p in room.glob("*.py") if p.name not in doors]
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
