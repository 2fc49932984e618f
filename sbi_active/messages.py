"""Messages by code: what each warning is called, its class, and where it is explained.

``messages.md`` beside this file is the registry: a code, a title, and what to do. The
site's page "What the warnings mean" is that file. A message ends in its code there,
"(SA301)", which is all that it needs to keep it through JSON, a file, or another
process. Built-in errors about an argument have none: they say what was expected, what
was given and what to do.
"""

from __future__ import annotations

import re
import sys
import warnings
from functools import cache
from pathlib import Path

_ENTRY = re.compile(r"^### (SA\d+) (.+)\n((?:.+\n)+)", re.MULTILINE)
_PACKAGE = f"{Path(__file__).parent}/"
_CODE = re.compile(r"\((SA\d+)\)$")
#: How messages ended in earlier versions, with or without the number.
_FORMER = re.compile(r"\(see warnings\.html#(?:sa(\d+)-)?([\w-]+)\)$")


class SBIActiveWarning(UserWarning):
    """A warning of this library; those of each hundred of codes have a class."""

    @property
    def code(self) -> str:
        """Code of the message, such as "SA301"."""
        return Message(str(self)).code


class BeliefWarning(SBIActiveWarning):
    """A belief may be wrong."""


class TrialWarning(SBIActiveWarning):
    """Something is odd about what was measured."""


class SimulationWarning(SBIActiveWarning):
    """Simulations were lost, or are not what they were taken for."""


class SimulatorWarning(SBIActiveWarning):
    """A simulator will not serve well."""


class LoopWarning(SBIActiveWarning):
    """The conclusions of a closed loop are limited."""


class StorageWarning(SBIActiveWarning):
    """Stored files are not as they should be."""


class RenamedWarning(SBIActiveWarning, DeprecationWarning):
    """A name goes in the next version."""


class ChangedWarning(SBIActiveWarning, FutureWarning):
    """A name means something else than in the last version."""


CATEGORIES = {
    "SA1": BeliefWarning,
    "SA2": TrialWarning,
    "SA3": SimulationWarning,
    "SA4": SimulatorWarning,
    "SA5": LoopWarning,
    "SA6": StorageWarning,
    "SA7": RenamedWarning,
}


class Message(str):
    """A sentence that knows its code.

    In the text the code comes first: "SA301 3 of 9 rows are missing".

    Example:
        >>> said = Message("SA301 3 of 9 rows are missing: 3 raised")
        >>> said, said.code, said.category.__name__
        ('3 of 9 rows are missing: 3 raised (SA301)', 'SA301', 'SimulationWarning')
        >>> Message(said) == said
        True
        >>> Message("few (see warnings.html#few-draws)")  # as it once was
        'few (SA114)'
    """

    __slots__ = ()

    def __new__(cls, text: object = "") -> Message:
        """Put a code that comes first to the end of a text."""
        code, _, rest = str(text).partition(" ")
        is_coded = code in explanations()
        said = rest + place(code) if is_coded else _FORMER.sub(_as_now, str(text))
        return super().__new__(cls, said)

    @property
    def code(self) -> str:
        """Code of the message, "" for a text without one."""
        found = _CODE.search(self)
        return found[1] if found else ""

    @property
    def category(self) -> type[SBIActiveWarning]:
        """Class of its warnings."""
        return CATEGORIES.get(self.code[:3], SBIActiveWarning)


@cache
def explanations() -> dict[str, tuple[str, str]]:
    """Return title and explanation of each code.

    Example:
        >>> explanations()["SA306"]
        ('No workers', 'A cluster has no workers. Start some; the calls wait.')
    """
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    return {c: (title, " ".join(t.split())) for c, title, t in _ENTRY.findall(text)}


def _as_now(former: re.Match[str]) -> str:
    """Return the end of a message for one of earlier versions."""
    number, slug = former.groups()
    titles = {t.lower().replace(" ", "-"): c for c, (t, _) in explanations().items()}
    code = f"SA{number}" if number else titles.get(slug, "")
    return f"({code})" if code else former[0]


def place(code: str) -> str:
    """Return a code as the end of a message."""
    return f" ({code})"


def warn(text: str, category: type[SBIActiveWarning] | None = None) -> None:
    """Warn at the line that called the package, with the code of the message.

    Args:
        text: Code, what is wrong and what to do.
        category: Class of the warning; None takes that of the code.
    """
    frame, level, said = sys._getframe(), 1, Message(text)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(said, category or said.category, stacklevel=level)


class Explained:
    """An error whose text ends in its code.

    Attributes:
        code: Code of the message.
    """

    code: str

    def __str__(self) -> str:
        return super().__str__() + place(self.code)
