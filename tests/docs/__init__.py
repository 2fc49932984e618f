import importlib.util
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]


def extension(name: str) -> ModuleType:
    """Return a module of ``docs/_ext``, which is no package."""
    path = ROOT / "docs" / "_ext" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
