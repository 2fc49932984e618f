"""Every warning from a loop that deserves it, and not from one that does not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Effect, Report, Trials, close_loop
from sbi_active.criticism.data.trials import Order
from sbi_active.criticism.report.cautions import find_warnings

ACTIONS = DiscreteActions(torch.linspace(-2, 2, 17))
PRIOR = BoxUniform(-3 * torch.ones(2), 3 * torch.ones(2))
NOISE = 0.1
TRUE = torch.tensor([[1.0, -0.5]], dtype=torch.float64)
SPREAD = torch.tensor([5, 12, 0, 9, 14, 2, 16, 7, 11, 3, 8, 15, 1, 13, 4, 10, 6])


def curve(theta, action, cubic=0.0):
    xi = action[:, 0]
    return (theta[:, 0] * xi + theta[:, 1] * xi**2 + cubic * xi**3)[:, None]


def rattle(theta, action, cubic=0.0):
    """What a change of theta by a millionth changes by more than the noise."""
    phase = 1e6 * theta.sum(1)[:, None] * (action + 3)
    return curve(theta, action, cubic) + 0.3 * torch.sin(phase)


def both(action):
    return 0.8 - 0.4 * action**3


TIMES = torch.linspace(0.05, 2.0, 40)


def decay(theta, action):
    return action * theta[:, :1] * torch.exp(-theta[:, 1:] * TIMES.to(theta))


def normal(sd: float) -> Independent:
    return Independent(Normal(torch.zeros(1), torch.full((1,), sd)), 1)


def bias(sd: float = 1.0) -> Effect:
    return Effect(
        "bias",
        hook="observation",
        prior=normal(sd),
        null=0.0,
        apply=lambda x, phi, action, context: x + phi,
    )


CUBIC = Effect.keyword("cubic", prior=normal(0.5))
DRIFT = Effect(
    "drift",
    hook="observation",
    prior=normal(0.1),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi * context.index[:, None],
    needs_order=True,
)


@dataclass(frozen=True)
class World:
    """What is measured, and what it is compared with; all but one part as usual."""

    fn: Callable[..., Tensor] = curve
    noise: float = NOISE
    declared: bool = True
    missing: Callable[[Tensor], Tensor | float] = lambda xi: 0.8
    scatter: float = 1.0
    num: int = 10
    in_order: bool = False
    order: Order = "known"
    repeats: int = 0
    effects: tuple[Effect, ...] = (bias(), CUBIC)
    designed: bool = False

    def report(self) -> Report:
        gen = torch.Generator().manual_seed(1)
        action = ACTIONS.values[SPREAD[: self.num]].double()
        action = action.sort(0).values if self.in_order else action
        action = torch.cat([action, action[:1].expand(self.repeats, 1)])
        noise = torch.randn(len(action), 1, generator=gen, dtype=torch.float64)
        x = self.fn(TRUE, action) + self.missing(action)
        x = x + self.scatter * self.noise * noise
        declared = GaussianNoise(self.noise) if self.declared else None
        return close_loop(
            SimulatorModel(self.fn, noise=declared),
            PRIOR,
            Trials(action, x, order=self.order),
            effects=self.effects,
            evaluate=False,
            designed=self.designed,
        )


def trajectories(
    *, stamped: bool, noise=GaussianNoise, correlation=0.95, summaries=None
) -> Report:
    gen = torch.Generator().manual_seed(0)
    action = torch.tensor([[1.0], [-1.0], [2.0], [-2.0], [1.5], [-1.5]])
    fresh = torch.randn(len(action), len(TIMES), generator=gen)
    error = fresh.clone()
    for k in range(1, len(TIMES)):
        scaled = (1 - correlation**2) ** 0.5 * fresh[:, k]
        error[:, k] = correlation * error[:, k - 1] + scaled
    x = decay(torch.tensor([[1.0, 0.8]]), action) + 0.05 * error
    return close_loop(
        SimulatorModel(decay, noise=noise(0.05)),
        BoxUniform(torch.tensor([0.2, 0.2]), torch.tensor([3.0, 3.0])),
        Trials(action, x, sample_times=TIMES if stamped else None),
        effects=[bias(0.2)],
        summaries=summaries,
        evaluate=False,
    )


def outcomes(*, cut: float, lost: Sequence[int] = ()) -> Report:
    """A simulator without an outcome beyond an action, and trials without one."""

    def ending(theta, action):
        return torch.where(action > cut, torch.nan, curve(theta, action))

    action = ACTIONS.values[SPREAD[:12]].double()
    gen = torch.Generator().manual_seed(1)
    x = curve(TRUE, action)
    x = x + NOISE * torch.randn(x.shape, generator=gen, dtype=torch.float64)
    x[[*lost]] = torch.nan
    return close_loop(
        SimulatorModel(ending, noise=GaussianNoise(NOISE)),
        PRIOR,
        Trials(action, x),
        effects=[bias()],
        evaluate=False,
    )


def held_out(*, missing: float) -> Report:
    """Trials with a bias, and held-out ones with another."""
    action = ACTIONS.values[SPREAD].double()
    gen = torch.Generator().manual_seed(1)
    noise = NOISE * torch.randn(17, 1, generator=gen, dtype=torch.float64)
    shift = torch.where(torch.arange(17) < 10, 0.8, missing)[:, None]
    return close_loop(
        SimulatorModel(curve, noise=GaussianNoise(NOISE)),
        PRIOR,
        Trials(
            action,
            curve(TRUE, action) + shift + noise,
            role=["fit"] * 10 + ["held out"] * 7,
        ),
        effects=[bias(), CUBIC],
    )


def examined(*, exploratory: bool) -> Report:
    action = ACTIONS.values[SPREAD[:6]].double()
    model = SimulatorModel(curve, noise=GaussianNoise(NOISE))
    loop = Criticism(model, PRIOR, Trials(action, curve(TRUE, action)))
    return loop.report(evaluate=False, exploratory=exploratory)


def cross_checked(*, missed: float) -> Report:
    """A report whose bare model's evidence came out otherwise from other starts."""
    report = usual.report()
    assert report.detection is not None
    check = report.detection.null_log_evidence + missed
    found = find_warnings(
        Trials(ACTIONS.values[SPREAD[:10]].double(), report.residuals.x),
        report.residuals,
        report.tracing,
        detection=replace(report.detection, null_cross_check=check),
    )
    return replace(report, warnings=found)


usual = World()
assumed = partial(StudentTNoise, df=5.0)

#: Code of the warning, and words where it has two kinds: a case that deserves it, and
#: one that comes near.
CASES: dict[str, tuple[Callable[[], Report], Callable[[], Report]]] = {
    "SA501": (
        replace(usual, declared=False, repeats=6).report,
        replace(usual, repeats=6).report,
    ),
    "SA502": (replace(usual, num=4).report, replace(usual, num=5).report),
    "SA503": (
        replace(usual, in_order=True).report,
        usual.report,
    ),
    "SA526": (
        replace(usual, order="unknown", effects=(bias(), DRIFT)).report,
        replace(usual, effects=(bias(), DRIFT)).report,
    ),
    "SA516": (
        replace(
            usual,
            num=12,
            effects=(bias(0.25), CUBIC),
            missing=lambda a: 0.8 - 0.4 * a**3,
        ).report,
        usual.report,
    ),
    "SA515": (
        replace(
            usual,
            num=12,
            effects=(bias(0.25), CUBIC),
            missing=lambda a: 0.8 - 0.4 * a**3,
        ).report,
        replace(
            usual,
            num=12,
            effects=(bias(0.5), CUBIC),
            missing=lambda a: 0.8 - 0.4 * a**3,
        ).report,
    ),
    "SA504": (
        replace(usual, designed=True).report,
        usual.report,
    ),
    "SA517": (
        replace(usual, missing=lambda a: 0.16).report,
        usual.report,
    ),
    "SA508": (
        replace(usual, fn=rattle, noise=0.02, effects=(bias(),)).report,
        replace(usual, effects=(bias(),), missing=lambda a: 0.0).report,
    ),
    "SA511": (
        partial(cross_checked, missed=1.5),
        partial(cross_checked, missed=0.5),
    ),
    "SA506": (
        replace(usual, fn=rattle).report,
        usual.report,
    ),
    "SA518": (
        replace(usual, num=14, missing=lambda a: 0.8 * torch.sin(4 * a)).report,
        usual.report,
    ),
    "SA519": (
        replace(usual, num=14, missing=lambda a: 0.0, scatter=6.0).report,
        usual.report,
    ),
    "SA507 sample_times": (
        partial(trajectories, stamped=False),
        partial(trajectories, stamped=True),
    ),
    "SA524": (
        partial(trajectories, stamped=False, correlation=0.0, summaries=5),
        partial(trajectories, stamped=False, correlation=0.0),
    ),
    "SA505 gave no measurement": (
        partial(outcomes, cut=9.0, lost=[3]),
        partial(outcomes, cut=9.0),
    ),
    "SA505 gave a measurement": (
        partial(outcomes, cut=1.9),
        partial(outcomes, cut=1.9, lost=[6]),  # the only action beyond
    ),
    "SA512": (
        partial(held_out, missing=0.0),
        partial(held_out, missing=0.8),
    ),
    "SA520": (
        partial(examined, exploratory=True),
        partial(examined, exploratory=False),
    ),
    "SA507 AutocorrelatedNoise": (
        partial(trajectories, stamped=True, noise=assumed),
        partial(trajectories, stamped=True, noise=assumed, correlation=0.0),
    ),
}


@cache
def the_usual_report() -> Report:
    return usual.report()


@pytest.mark.parametrize("kind", [*CASES])
def test_each_warning_has_its_case(kind):
    code, _, words = kind.partition(" ")

    def said(report: Report) -> list[str]:
        return [w for w in report.warnings if w.code == code and words in w]

    deserved, near = CASES[kind]
    report = deserved()
    (sentence,) = said(report)
    assert f"- {sentence}" in " ".join(str(report).split())
    assert not said(the_usual_report() if near == usual.report else near())


def test_the_usual_case_has_no_warnings():
    report = the_usual_report()
    assert report.verdict == "bias"
    assert report.warnings == ()


def test_trials_of_unknown_order_drift_nowhere():
    sorted_records = replace(usual, in_order=True, effects=(bias(), DRIFT, CUBIC))
    report = replace(sorted_records, order="unknown").report()
    assert "SA503" not in [w.code for w in report.warnings]
    assert {"bias", "cubic"} <= {*report.probabilities}
    assert "drift" not in report.probabilities
    assert "drift" in sorted_records.report().probabilities


def test_the_verdict_line_says_where_it_is_not_robust():
    report = replace(usual, missing=lambda a: 0.16).report()
    assert "not robust to its prior" in str(report).splitlines()[0]
    assert "not robust" not in str(the_usual_report())


def test_the_edge_is_that_of_phi_among_all_effects_that_were_added():
    def parabola(theta, action, cubic=0.0):
        return theta[:, :1] * action + cubic * action**2

    effect = replace(
        CUBIC,
        name="quadratic",
        prior=normal(1.0),
        apply=lambda value, phi, action, context: {**value, "cubic": phi},
    )
    world = World(
        fn=parabola,
        num=12,
        declared=False,  # where left-out trials are not asked first
        repeats=4,
        missing=lambda a: 0.5 + 1.7 * a**2,
        effects=(bias(0.5), effect),
    )
    report = world.report()
    alone = {e.name: e.mean[0] for e in report.tracing.estimates}
    assert report.verdict == "bias + quadratic"
    assert alone["bias"] > 0.5 * 2.58  # where it must do the work of both
    assert "SA515" not in [w.code for w in report.warnings]
