"""The report of a closed loop: verdict, evidence, and the error before and after."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import cloudpickle

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.misfit.evaluation import evaluate_held_out
from sbi_active.criticism.next_action import severe_tests
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.gate import Gate, gate_of
from sbi_active.criticism.report.sections import (
    cautions_with_codes,
    figures,
    head,
    page,
    tables_of,
)
from sbi_active.criticism.report.words import cautions
from sbi_active.criticism.results import NONE, Evaluation
from sbi_active.criticism.steps.predictive import find_residuals
from sbi_active.display.figures import legible
from sbi_active.display.notebook import card, items, table
from sbi_active.plain import plain
from sbi_active.progress import stage


class Report(Contents):
    """Report of the closed loop, see :class:`.Contents`.

    ``print(report)`` has the verdict in its first line.
    """

    def __str__(self) -> str:
        return page(self).text()

    def __repr__(self) -> str:
        return f"Report({head(self)[0]!r})"

    def _repr_html_(self) -> str:
        line, *sentences = head(self)
        tables = tables_of(self)
        names = [
            name for name in ("Effects", "Error before and after") if name in tables
        ]
        return card(
            line,
            " ".join(sentences),
            *[table(tables[name]) for name in names],
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
                "summary": head(self)[1:],
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


def report_of(
    loop: Any,
    evaluation: Evaluation | None,
    held_out: Trials | None,
    *,
    plan: bool,
    **options: bool,
) -> Report:
    """Return the report of all steps of a comparison.

    Args:
        loop: The steps, a :class:`.Criticism`.
        evaluation: Error before and after; None leaves it out.
        held_out: Trials that had no part in them.
        plan: Whether to plan the next action, as in :meth:`.Criticism.report`.
        **options: Whether it is ``designed`` or ``exploratory``, as there.
    """
    tracing = loop.judged(evaluation)
    is_withdrawn = tracing.refuted is not None or bool(tracing.bounds.replaces)
    if is_withdrawn and evaluation is not None and held_out is not None:
        evaluation = evaluate_held_out(loop.rivals, tracing, held_out)
    simulator, prior = loop.add(tracing.chosen)
    space = loop.actions if plan else None
    next_action = None if space is None else loop.next_action()
    with stage("residuals and tests", show_progress=loop.show_progress):
        residuals, after = loop.residuals(), None
        if tracing.verdict != NONE:
            after = find_residuals(loop.rivals, tracing.key)
        tests = () if space is None else severe_tests(loop.rivals, tracing, space)
    return build_report(
        loop.trials,
        loop=loop,
        residuals=residuals,
        residuals_after=after,
        detection=loop.detect(),
        tracing=tracing,
        simulator=simulator,
        prior=prior,
        evaluation=evaluation,
        next_action=next_action,
        actions=loop.actions,
        digest=loop.digest,
        num_simulations=loop.rivals.simulator.num_simulations,
        severe_tests=tests,
        **options,
    )


def build_report(
    trials: Trials,
    *,
    actions: ActionSpace | None = None,
    designed: bool = False,
    exploratory: bool = False,
    loop: Any = None,
    **parts: Any,
) -> Report:
    """Put the parts together, and find what a reader must be warned of.

    Args:
        trials: The measured trials.
        actions: Permitted actions, for names and units.
        designed: Whether the actions were chosen for their information.
        exploratory: Whether what was frozen was changed after the data were seen.
        loop: The comparison, as in :func:`.cautions`.
        **parts: Parts of :class:`.Contents`.
    """
    labels = trials.action_labels or (actions and actions.entry_labels)
    if labels is None:
        labels = tuple(f"action {i + 1}" for i in range(trials.action.shape[1]))
    channels = trials.channel_labels or parts["simulator"].channel_names
    report = Report(
        **parts,
        warnings=(),
        exploratory=exploratory,
        num_trials=len(trials.fit),
        action_labels=labels,
        action_is_label=trials.action_is_label,
        channel_names=None if channels is None else tuple(channels),
    )
    return replace(
        report, warnings=cautions(report, trials, designed=designed, loop=loop)
    )


def _restored(parts: bytes) -> Report:
    return Report(**cloudpickle.loads(parts))
