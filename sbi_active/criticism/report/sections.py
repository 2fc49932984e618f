"""Sections of a report."""

from __future__ import annotations

from collections.abc import Iterator

from sbi_active.criticism.report import findings, outlook
from sbi_active.criticism.report.conditions import first_paragraph
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.headline import verdict_line
from sbi_active.criticism.report.under_misfit import admitted_models
from sbi_active.display.page import Page, Section


def page(report: Contents) -> Page:
    """Return a report as a page, the verdict its title."""
    return Page(verdict_line(report), [*_sections(report)], [first_paragraph(report)])


def _sections(report: Contents) -> Iterator[Section]:
    if report.warnings:
        yield Section("Warnings", items=report.warnings, warns=True)
    if report.tracing.misfit is not None:
        yield admitted_models(report, report.tracing.misfit)
    yield findings.effects(report)
    yield findings.equivalences(report)
    yield findings.residuals(report)
    yield findings.by_trial(report)
    yield outlook.errors(report)
    if report.leave_one_out:
        yield findings.leave_one_out(report)
    yield outlook.parameters(report)
    yield outlook.next_action(report)
    yield _record(report)


def _record(report: Contents) -> Section:
    evidences = report.tracing.evidences
    spent = sum(e.num_simulations for e in evidences.values())
    items = [f"evidence cost {spent:,} simulated trials"]
    moved = [name for name, e in evidences.items() if e.engine == "smc"]
    if report.tracing.misfit is not None:
        items.append("evidence by linearized models with a residual process in each")
    elif len(moved) < len(evidences):
        items.append("evidence by least squares and importance sampling")
    if moved:
        which = ", ".join(sorted(moved))
        items.append(
            f"evidence by sequential Monte Carlo, where that did not serve: {which}"
        )
    if report.detection.null_cross_check is not None:
        items.append(
            f"log evidence of the bare model {report.detection.null_log_evidence:.2f}, "
            f"from other starts {report.detection.null_cross_check:.2f}"
        )
    if report.digest:
        items.append(
            f"hash of noise, effects and priors, declared before the data: "
            f"{report.digest}"
        )
    return Section("Record", items=tuple(items))
