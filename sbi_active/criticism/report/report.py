"""The report of a closed loop: verdict, evidence, and the error before and after."""

from __future__ import annotations

from dataclasses import asdict, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import cloudpickle

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.gate import Gate, gate_of
from sbi_active.criticism.report.page import figures, page
from sbi_active.criticism.report.words import cautions
from sbi_active.display.figures import legible
from sbi_active.display.notebook import card, items
from sbi_active.messages import Message
from sbi_active.plain import plain


class Report(Contents):
    """Report of the closed loop, see :class:`.Contents`.

    ``print(report)`` has the verdict in its first line.
    """

    def __str__(self) -> str:
        return page(self).text()

    def __repr__(self) -> str:
        return f"Report({page(self).title!r})"

    def _repr_html_(self) -> str:
        made = page(self)
        return card(made.title, *made.lead, items(cautions(self)))

    @cached_property
    def warnings(self) -> tuple[Message, ...]:
        """What limits the conclusions, a sentence each."""
        return (*map(Message, cautions(self)),)

    @property
    def gate(self) -> Gate:
        """Whether the simulator may be used, see :class:`.Gate`."""
        return gate_of(self)

    def __reduce__(self) -> tuple[Any, ...]:
        # Effects are lambdas and local functions as a rule, which pickle refuses.
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return _restored, (cloudpickle.dumps(parts),)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON has it: numbers, texts, and all sections."""
        made, misfit, holds = page(self), self.tracing.misfit, self.has_probabilities
        found = {
            "verdict": self.verdict,
            "line": made.title,
            "summary": made.lead,
            "warnings": [said.split(" ", 1) for said in cautions(self)],
            "chosen": self.tracing.chosen,
            # By the fitted trials alone they would contradict the verdict.
            "probabilities": self.probabilities if holds else None,
            "credible_set": self.credible_set if holds else None,
            "misfit": misfit and asdict(misfit),
            "equivalent": self.equivalent,
            "next_action": self.next_action and asdict(self.next_action),
            "severe_tests": [*map(asdict, self.severe_tests)],
            "gate": self.gate.to_dict(),
            "digest": self.digest,
            "sections": [*map(asdict, made.sections)],
        }
        for name in ("before_after", "parameters", "residuals_by_trial"):
            found[name] = getattr(self, name).to_dict("records")
        return plain(found)

    def to_markdown(self) -> str:
        """Return the report as Markdown, figures by the names that ``save`` gives."""
        return page(self).markdown()

    def to_html(self) -> str:
        """Return the report as one self-contained page with its figures."""
        return page(self).html(figures(self))

    def save(self, directory: str | Path) -> Path:
        """Write report.txt, report.md, report.html and the figures as PNG.

        Args:
            directory: Folder, made where it does not exist.

        Returns:
            The page's path.
        """
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        texts = {"txt": f"{self}\n", "md": self.to_markdown(), "html": self.to_html()}
        for ending, text in texts.items():
            path = directory / f"report.{ending}"
            path.write_text(text, encoding="utf-8", errors="replace")
        for name, figure in figures(self).items():
            legible(figure).savefig(directory / f"{name}.png", dpi=150)
        return directory / "report.html"


def _restored(parts: bytes) -> Report:
    return Report(**cloudpickle.loads(parts))
