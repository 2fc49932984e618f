"""Write the reference: a page a package, every public name on it.

The names are those of ``__all__``, and of the modules in ``FURTHER`` what users get
back or declare with and need not import, so that no name can be forgotten.
"""

import importlib
import inspect
import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any

from sphinx.application import Sphinx

import sbi_active

PAGES = Path(__file__).parents[1] / "reference" / "api"
EXAMPLES = PAGES.parent / "examples"
PACKAGES = [*sbi_active._PACKAGES, "pyro", "tasks"]
#: Modules whose classes and functions users meet without importing them, by package.
FURTHER = {
    "actions": {"sbi_active.actions.waveforms": ()},
    "campaign": {"sbi_active.campaign.options": ("CampaignDetails",)},
    "criticism": {
        "sbi_active.criticism.results": (),
        "sbi_active.criticism.contradictions": ("SevereTest",),
    },
    "design": {
        "sbi_active.export": ("to_inference_data",),
        "sbi_active.design.estimators.base": ("CandidateSimulations",),
        "sbi_active.design.estimators.contrast": ("InfoNCEGain",),
        "sbi_active.design.search": ("Evaluations", "Objective"),
    },
    "diagnostics": {
        "sbi_active.diagnostics.beliefs": ("BeliefCheck",),
        "sbi_active.diagnostics.calibration": ("Calibration", "Stratum"),
    },
    "inference": {
        "sbi_active.inference.beliefs.diagnostics": (),
        "sbi_active.inference.networks.ratio_network": ("RatioClassifier",),
        "sbi_active.inference.rounds.rows": ("Observation",),
    },
    "mujoco": {
        "sbi_active.mujoco.models.changes": ("ModelChange", "StateChange"),
        "sbi_active.mujoco.robot": ("Robot",),
    },
    "pyro": {
        "sbi_active.pyro.denoising": ("Denoised", "denoise"),
        "sbi_active.pyro.models": ("PyroProblem",),
    },
    "simulation": {"sbi_active.simulation.check": ("SimulatorReport",)},
}
#: A shape such as (n, *x_shape), whose star is no emphasis; words in a row may be.
STAR = re.compile(r"(?<![\\\w*`])\*(?=[a-z_]+\b(?!\*))(?![a-z]+( [a-z]+)+\*)")
END = re.compile(r"(?<=[A-Za-z])_(?=\W|$)")  # of a column's prefix: no link
LETTER = re.compile(r"^(\s*(?::\w+ [^:]+: )?)(?=\w\.$)")  # no first item of a list
#: Ancestors of other projects: their members are documented there.
FOREIGN = (
    "Distribution,NPE_C,NLE_A,NRE_A,NeuralPosterior,Module,BaseException,Warning,object"
)


def examples(package: str) -> tuple[str, dict[str, str]]:
    """Return what the examples beside the docstrings begin with, and each by name."""
    path = EXAMPLES / f"{package}.txt"
    if not path.exists():
        return "", {}
    setup, *blocks = path.read_text(encoding="utf-8").split("\n# ")
    return setup, dict(block.split("\n", 1) for block in blocks)


def public(module: ModuleType, names: tuple[str, ...] = ()) -> list[str]:
    """Return the names of a module that are documented."""
    if names:
        return [*names]
    if hasattr(module, "__all__"):
        return [*module.__all__]
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and getattr(value, "__module__", None) == module.__name__
        and (inspect.isclass(value) or inspect.isfunction(value))
    ]


def groups(package: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the modules of a page, and which of their names it holds."""
    home = f"sbi_active.{package}"
    yield home, public(importlib.import_module(home))
    for name, chosen in FURTHER.get(package, {}).items():
        yield name, public(importlib.import_module(name), chosen)


def first_line(value: object) -> str:
    """Return what a name is, in a line."""
    text = (inspect.getdoc(value) or "").split("\n\n")[0].replace("\n", " ")
    text = re.sub(r":math:`(.+?)`", r"$\1$", text).replace("|", "\\|")
    text = re.sub(r":\w+:`[~.]?(.+?)`", r"`\1`", text)
    return text if callable(value) else f"All of them: {', '.join(value)}."


def page(package: str) -> str:
    """Return the page of a package, as MyST."""
    home = importlib.import_module(f"sbi_active.{package}")
    lines = [f"# `sbi_active.{package}`", "", "```{eval-rst}"]
    lines += [inspect.getdoc(home) or "", "```", ""]
    setup, blocks = examples(package)
    if setup:
        lines += ["Examples below begin with", "", "```pycon", setup.strip(), "```", ""]
    for module_name, names in groups(package):
        module = importlib.import_module(module_name)
        if module is not home:
            lines += [f"## From `{module_name}`", ""]
        lines += ["```{eval-rst}", f".. py:currentmodule:: {module_name}", ""]
        for name in names:
            lines += [_directive(module_name, name, getattr(module, name)), ""]
            if name in blocks:
                lines += ["   Example::", ""]
                lines += [
                    f"      {line}".rstrip() for line in blocks[name].splitlines()
                ]
                lines += [""]
        lines += ["```", ""]
    return "\n".join(lines)


def _directive(module: str, name: str, value: Any) -> str:
    if inspect.isclass(value):
        head = f".. autoclass:: {module}.{name}{_arguments(value)}\n   :members:"
        if issubclass(value, (tuple, Enum)):
            return head.removesuffix("\n   :members:")  # fields stand in its docstring
        return f"{head}\n   :inherited-members: {FOREIGN}"
    if inspect.isroutine(value):
        return f".. autofunction:: {module}.{name}"
    head = f".. py:data:: {name}\n   :module: {module}"
    return f"{head}\n\n   All of them: {', '.join(value)}."


def _arguments(value: type) -> str:
    """Return the arguments of a class where autodoc cannot: it takes self off twice."""
    if not any(base.__module__.startswith("sbi.inference") for base in value.__mro__):
        return ""
    bare = [
        p.replace(annotation=inspect.Parameter.empty)
        for p in inspect.signature(value).parameters.values()
    ]
    return str(inspect.Signature(bare))


def overview() -> str:
    """Return the table of all public names."""
    lines = ["| name | package | what it is |", "|---|---|---|"]
    rows = {}
    for package in PACKAGES:
        module = importlib.import_module(f"sbi_active.{package}")
        for name in module.__all__:
            text = first_line(getattr(module, name))
            link = f"[`{name}`](#sbi_active.{package}.{name})"
            top = "**top level**, " if name in sbi_active.__all__ else ""
            rows[name] = f"| {link} | {top}`{package}` | {text} |"
    return "\n".join([*lines, *(rows[n] for n in sorted(rows, key=str.lower))]) + "\n"


def _prepared(
    app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Escape what is no markup; of other projects' docstrings take the first line."""
    home = getattr(inspect.unwrap(value), "__module__", "") if callable(value) else ""
    if home and not home.startswith("sbi_active"):
        first = " ".join(lines).replace("$", "").split(". ")[0].rstrip(".")
        lines[:] = [f"{first} (of ``{home}``)."]
    lines[:] = _without_markup(lines)


def _without_markup(lines: list[str]) -> Iterator[str]:
    """Yield lines with escapes, displayed formulas as they are."""
    margin = None  # of the formula that a line is in
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if margin is not None and line.strip() and indent <= margin:
            margin = None
        if line.lstrip().startswith(".. math::"):
            margin = indent
        yield line if margin is not None else _escaped(line)


def _escaped(line: str) -> str:
    line = LETTER.sub(r"\1\\", line)
    parts = re.split(r"(``.*?``|`.*?`)", line)  # what is literal stays
    return "".join(
        p if p.startswith("`") else STAR.sub(r"\\*", END.sub(r"\\_", p)) for p in parts
    )


def _write(path: Path, text: str) -> None:
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _generate(app: Sphinx) -> None:
    PAGES.mkdir(parents=True, exist_ok=True)
    for page_of_before in {*PAGES.glob("*.md")} - {PAGES / f"{p}.md" for p in PACKAGES}:
        page_of_before.unlink()
    for package in PACKAGES:
        _write(PAGES / f"{package}.md", page(package))
    _write(PAGES / "names.txt", overview())


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before they are read."""
    app.connect("builder-inited", _generate)
    app.connect("autodoc-process-docstring", _prepared, priority=800)  # after Google's
    return {"parallel_read_safe": True, "parallel_write_safe": True}
