"""A model's source: read, edited and compiled, here and in every worker process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sbi_active.expected import require

try:
    import mujoco as mujoco_module
    import mujoco.rollout
except ImportError as error:
    raise ImportError(
        "expected MuJoCo 3.5 or later; got none; run pip install 'sbi-active[mujoco]'"
    ) from error

#: The module, whose types say less than its documentation.
mujoco: Any = mujoco_module
Edit = Callable[[Any], None]


@contextmanager
def quiet() -> Iterator[None]:
    """Keep MuJoCo from printing a line, and writing a file, a row that diverges.

    Such rows are counted as invalid outcomes.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_nothing)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _nothing(text: str) -> None:
    """Take a warning and drop it."""


class Source:
    """An MJCF and what is changed in it before it is compiled.

    A spec is written down as text, with six digits: what is compiled from it in another
    process has them. The model itself is compiled from the spec as it is given, but for
    its textures, which move nothing and take most of many a compilation.

    Args:
        given: Path of an MJCF, its text, or an ``MjSpec``, which is copied.
        edits: Functions that are called with the spec in this order; they go to other
            processes too.

    Raises:
        ValueError: If there is no such file, or it does not compile.
    """

    def __init__(self, given: Any, edits: tuple[Edit, ...] = ()) -> None:
        self.edits = edits
        self._text, self._path, self._assets, self._folder = None, None, {}, ""
        self._spec = None
        if isinstance(given, mujoco.MjSpec):
            own = given.copy()
            _drop_textures(own)
            self._spec = own.copy()  # MuJoCo 3.5 looks for them in the first copy
            # From here meshes are read, in this process and in others.
            self._spec.modelfiledir = str(Path(given.modelfiledir).resolve())
        elif isinstance(given, str) and given.lstrip().startswith("<"):
            self._text = given
        else:
            self._path = Path(given).resolve()
            is_there, got = self._path.is_file(), f"none at {self._path}"
            require(is_there, "an MJCF file", got, "check the path")
        self.compile()
        if self._spec is not None:
            self._text, self._assets = self._spec.to_xml(), dict(self._spec.assets)
            self._folder = self._spec.modelfiledir

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_spec": None}

    def spec(self) -> Any:
        """Return the spec, edited; the same in every process."""
        if self._path is not None:
            spec = mujoco.MjSpec.from_file(str(self._path))
        else:
            spec = mujoco.MjSpec.from_string(self._text, assets=self._assets)
            spec.modelfiledir = self._folder
        return self._edited(spec)

    def exact(self) -> Any:
        """Return the spec, edited, with all digits where this process has it."""
        return self.spec() if self._spec is None else self._edited(self._spec.copy())

    def compile(self) -> Any:
        """Return the model, with all digits where this process has the spec."""
        return self.exact().compile()

    def edited(self, *edits: Edit) -> Source:
        """Return a source that is changed further."""
        other = object.__new__(Source)
        vars(other).update(vars(self), edits=(*self.edits, *edits))
        return other

    def _edited(self, spec: Any) -> Any:
        _drop_textures(spec)
        for edit in self.edits:
            edit(spec)
        return spec


def _drop_textures(spec: Any) -> None:
    """Leave materials their colors alone."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in [*spec.textures]:
        spec.delete(texture)
