"""The oracles: answers that hold, controls that fail, and the quick part of the table.

``python -m benchmarks oracles`` runs every way on every problem that it claims.
"""

from __future__ import annotations

import warnings
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from sbi_active import Campaign, RefinementOptions
from sbi_active.inference import refine
from sbi_active.inference.declared.refining import SimulatedBelief
from tests.oracles.judging import Found, Judged, judged
from tests.oracles.problem import Problem, gauss
from tests.oracles.problems import PROBLEMS
from tests.oracles.reference import Answer, Weighted, answer, answers
from tests.oracles.ways import WAYS, trials_of

# Engines that are wrong on purpose, and the right one, by the committed proposals


#: Draws of a proposal, and of the belief that they give.
NUM_PROPOSED, NUM_DRAWS = 6_000, 4_000
#: Nats by which a wrong evidence is off: a factor of twenty, a verdict's threshold.
NATS = 3.0


def right(own: Problem, answer: Answer, rng: np.random.Generator) -> Found:
    """Return a reference sample with its evidence."""
    sample = Weighted.drawn(own, answer.proposal, NUM_PROPOSED, rng)
    theta = own.to_theta(sample.draws(NUM_DRAWS, rng))
    return Found(theta=theta, log_evidence=sample.log_evidence, error=sample.error)


def of_another_noise(own: Problem, answer: Answer, rng: np.random.Generator) -> Found:
    """Return the belief of a noise that is halved, and doubled where none is left."""
    if own.closed_form is not None:
        mean, cov, _ = own.closed_form(own.with_error(_scaled(own, 0.5)))
        return Found(theta=rng.multivariate_normal(mean, cov, NUM_DRAWS))
    for factor in (0.5, 2.0):
        other = own.with_error(_scaled(own, factor))
        sample = Weighted.drawn(other, answer.proposal, NUM_PROPOSED, rng)
        if np.isfinite(sample.log_evidence):
            break
    return Found(theta=other.to_theta(sample.draws(NUM_DRAWS, rng)))


def _scaled(own: Problem, factor: float) -> Any:
    error: Any = own.error
    return replace(error, scale=factor * error.scale)


def without_a_mode(own: Problem, answer: Answer, rng: np.random.Generator) -> Found:
    """Return the belief without its least likely region."""
    theta = right(own, answer, rng).theta
    least = min(answer.regions, key=lambda k: answer.regions[k].probability)
    return Found(theta=theta[own.region(theta) != least])


def of_another_evidence(
    own: Problem, answer: Answer, rng: np.random.Generator
) -> Found:
    """Return the right belief with an evidence that is off."""
    found = right(own, answer, rng)
    assert found.log_evidence is not None
    return replace(found, log_evidence=found.log_evidence + NATS)


# The quick part of the table


#: What takes less than two seconds a run.
QUICK = {
    "refine": (
        *("linear_1_1", "linear_20_4", "linear_20_200", "numerical"),
        *("compartments_6", "decay", "eight_modes", "banana", "jump"),
        *("edge", "student", "missing", "invalid"),
    ),
    "refine, noise drawn": ("linear_3_10", "banana", "edge", "hard_edged"),
    "close_loop, bare model": (
        *("linear_3_10", "linear_10_4", "numerical", "oscillator", "compartments_6"),
        *("eight_modes", "banana", "jump", "edge", "student", "missing", "invalid"),
    ),
    "identify": ("compartments_6", "decay", "missing"),
}
#: Posteriors of several modes or with a curved ridge, whose normal fits vary by the
#: seed by a tenth of a nat: the median of so many seeds is judged.
VARIED, NUM_SEEDS = ("eight_modes", "banana"), 3


def rng_of(name: str) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(name.encode()))


def run(problem: str, way: str, seed: int = 0) -> tuple[Judged, bool | None]:
    own = PROBLEMS[problem]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.manual_seed(seed)
        simulator = own.simulator(is_declared=WAYS[way].is_declared)
        found = WAYS[way].run(own, simulator, seed)
    return judged(own, answers()[problem], found), found.trustworthy


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_answer_holds_and_what_is_wrong_is_seen(name):
    """Fresh draws agree; another noise, a lost mode and another evidence do not."""
    own, known = PROBLEMS[name](), answers()[name]
    result = judged(own, known, right(own, known, rng_of(name)))
    assert not result.faults(), result
    assert known.effective > 20_000
    assert known.error < 0.01
    wrong = [of_another_noise, of_another_evidence]
    if len(known.regions) > 1:
        wrong.append(without_a_mode)
    for engine in wrong:
        result = judged(own, known, engine(own, known, rng_of(name)))
        assert result.faults(), (engine.__name__, result)


@pytest.mark.parametrize(
    "name",  # of more parameters the search for a proposal takes longer
    ["linear_1_1", "linear_3_10", "linear_6_40"],
)
def test_long_importance_sampling_gives_a_closed_form(name):
    """The sampler behind the other answers, where the answer is known without it."""
    other = replace(PROBLEMS[name](), closed_form=None)
    sampled = answer(other, num=2_000, final=4_000, seed=1)
    exact = answers()[name].log_evidence
    assert sampled.log_evidence == pytest.approx(exact, abs=5 * sampled.error)


@pytest.mark.parametrize(
    ("problem", "way"), [(p, way) for way, names in QUICK.items() for p in names]
)
def test_the_way_gives_the_answer(problem, way):
    seeds = range(NUM_SEEDS if problem in VARIED else 1)
    results = [run(problem, way, seed) for seed in seeds]
    result, says = sorted(results, key=lambda r: r[0].kl)[len(results) // 2]
    assert not result.faults(), (result, says)


def test_a_parameter_that_no_trial_informs_changes_nothing():
    """Six parameters, and the same six beside one: one posterior."""
    own = PROBLEMS["linear_6_40"]()
    seven = {"space": gauss(7), "truth": np.append(own.truth, 0.0), "given": own.x}
    seven |= {"mean": lambda theta, action: own.mean(theta[:, :6], action)}
    settings = RefinementOptions(defensive=1e-6)
    moments = []
    for each in (own, replace(own, closed_form=None, **seven)):
        simulator = each.simulator(is_declared=True)
        given = each.prior, *trials_of(each)
        belief = refine(simulator, *given, settings=settings, seed=0)
        theta = belief.sample((5_000,)).double().numpy()[:, :6]
        moments.append((theta.mean(0), theta.std(0)))
    (mean_6, sd_6), (mean_7, sd_7) = moments
    assert (np.abs(mean_6 - mean_7) / sd_6).max() < 0.15
    assert (np.abs(np.log(sd_7 / sd_6))).max() < 0.15


def test_a_discrete_parameter_gets_its_probability():
    own = PROBLEMS["payload"]()
    simulator = own.simulator(is_declared=True)
    campaign = Campaign(simulator, own.prior, [3.0])
    campaign.attach([3.0], torch.from_numpy(own.x[0]).float())
    is_on = campaign.update().sample((4_000,))[:, 1] > 0.5
    probability = answers()["payload"].regions[1].probability
    assert float(is_on.double().mean()) == pytest.approx(probability, abs=0.05)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("order", [[3, 2, 1, 0], [2, 3, 0, 1]])
def test_a_trial_that_failed_may_come_at_any_time(order):
    """A mode by the trials with outcomes may be impossible by the one without."""
    own, past, belief = PROBLEMS["invalid"](), None, None
    simulator = own.simulator(is_declared=True)
    action, x = (part[order] for part in trials_of(own))
    for k in range(1, 5):
        belief = refine(simulator, own.prior, action[:k], x[:k], past=past, seed=3)
        assert isinstance(belief, SimulatedBelief)
        past = belief.histories
    torch.manual_seed(0)
    found = Found(theta=belief.sample((5_000,)).double().numpy())
    assert not judged(own, answers()["invalid"], found).faults()
