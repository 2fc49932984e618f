"""The report of a closed loop: verdict, evidence, and the error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import cloudpickle

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.report.cautions import cautions
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.figures import figures
from sbi_active.criticism.report.gate import Gate, gate_of
from sbi_active.criticism.report.sections import (
    cautions_with_codes,
    page,
    sentences,
    verdict_line,
)
from sbi_active.criticism.report.words import number
from sbi_active.display.figures import legible
from sbi_active.display.notebook import card, items, table
from sbi_active.display.table import Table
from sbi_active.messages import Message
from sbi_active.plain import plain


class Report(Contents):
    """Report of the closed loop, see :class:`.Contents`.

    ``print(report)`` has the verdict in its first line.
    """

    def __str__(self) -> str:
        return page(self).text()

    def __repr__(self) -> str:
        return f"Report({verdict_line(self)!r})"

    def _repr_html_(self) -> str:
        scored = self.before_after[["metric", "before", "after", "ratio"]]
        errors = [(n, *map(number, row)) for n, *row in scored.itertuples(index=False)]
        shares = self.probabilities if self.has_probabilities else {}
        likely = sorted(shares.items(), key=lambda item: -item[1])[:5]
        return card(
            verdict_line(self),
            " ".join(sentences(self)),
            table(
                Table(("model", "probability"), [(n, f"{p:.2f}") for n, p in likely])
            ),
            table(Table(("metric", "before", "after", "ratio or difference"), errors)),
            items([f"{code} {said}" for code, said in cautions_with_codes(self)]),
        )

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
        plan = None if self.next_action is None else asdict(self.next_action)
        tables = {
            "before_after": self.before_after,
            "parameters": self.parameters,
            "residuals_by_trial": self.residuals_by_trial,
        }
        return plain(
            {
                "verdict": self.verdict,
                "line": made.title,
                "summary": sentences(self),
                "warnings": cautions_with_codes(self),
                "chosen": self.tracing.chosen,
                # By the fitted trials alone they would contradict the verdict.
                "probabilities": self.probabilities if holds else None,
                "credible_set": self.credible_set if holds else None,
                "misfit": misfit and asdict(misfit),
                "equivalent": self.equivalent,
                **{name: table.to_dict("records") for name, table in tables.items()},
                "next_action": plan,
                "severe_tests": [asdict(test) for test in self.severe_tests],
                "gate": self.gate.to_dict(),
                "digest": self.digest,
                "sections": [*map(asdict, made.sections)],
            }
        )

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


def build_report(
    *,
    trials: Trials,
    actions: ActionSpace | None = None,
    designed: bool = False,
    exploratory: bool = False,
    warnings: Sequence[str] = (),
    **parts: Any,
) -> Report:
    """Put the parts together, and find what a reader must be warned of.

    Args:
        trials: The measured trials.
        actions: Permitted actions, for names and units.
        designed: Actions were chosen for their information.
        exploratory: Whether what was frozen was changed afterwards.
        warnings: Further warnings.
        **parts: Parts of :class:`.Contents`.
    """
    labels = [f"action {i + 1}" for i in range(trials.action.shape[1])]
    if trials.action_labels is not None:
        labels = trials.action_labels
    elif actions is not None:
        pairs = zip(actions.names, actions.units, strict=True)
        labels = [f"{name} [{unit}]" if unit else name for name, unit in pairs]
    channels = trials.channel_labels or parts["simulator"].channel_names
    report = Report(
        **parts,
        warnings=(),
        exploratory=exploratory,
        num_trials=len(trials.fit),
        action_labels=tuple(labels),
        action_is_label=trials.action_is_label,
        channel_names=None if channels is None else tuple(channels),
    )
    found = cautions(report, trials, designed=designed)
    return replace(report, warnings=(*found, *map(Message, warnings)))


def _restored(parts: bytes) -> Report:
    return Report(**cloudpickle.loads(parts))
