"""Outcomes without a measurement count: an exact discrete-continuous world.

A push of strength a gives x = a theta + N(0, 1), or nothing with a probability that
grows with the strength and depends on theta; its information is known by enumeration of
validity and quadrature over theta and x.

Every estimator is held to three of its standard errors of the exact value.
"""

import math
import warnings
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_active import ASBI, DiscreteActions, InformationGainDesigner, MixtureDensity
from sbi_active.design import EntropyGain, NestedGain, PosteriorGain
from sbi_active.design.estimators.base import CandidateSimulations, standard_error
from sbi_active.design.estimators.posterior import ParameterGain
from sbi_active.seeding import row_normals
from sbi_active.simulation import GaussianNoise, MissingRowsWarning, SimulatorModel
from tests import linear_gaussian
from tests.design import test_designer as pushes

PRIOR = MultivariateNormal(torch.zeros(1), torch.eye(1))
ACTIONS = torch.tensor([[0.5], [1.0], [2.0], [8.0]])
GRID = -5.985 + 0.03 * torch.arange(400).double()  # no point at an edge of validity
WEIGHT = torch.softmax(-0.5 * GRID**2, 0)  # of the prior on the grid
NOISE = GaussianNoise(1.0)


@dataclass(frozen=True)
class Fragile:
    """Pushes that fail.

    Attributes:
        luck: 0 for validity that is a function of theta; the width of the logistic
            otherwise.
    """

    luck: float

    def log_valid(self, theta: Tensor, action: Tensor) -> Tensor:
        """Log probability of a measurement; strong pushes need a large theta."""
        margin = theta - 0.3 * (action - 2)
        if self.luck == 0:
            return torch.where(margin > 0, 0.0, -torch.inf).to(theta)
        return torch.nn.functional.logsigmoid(margin / self.luck)

    def mean(self, theta: Tensor, action: Tensor) -> Tensor:
        """Noise-free outcome, NaN where there is none."""
        lost = torch.rand_like(theta).log() > self.log_valid(theta, action)
        return torch.where(lost, torch.nan, action * theta)

    def __call__(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return outcomes, shape (n, 1)."""
        mean = self.mean(theta, action)
        return mean + torch.randn_like(mean)

    def simulations(self, num_samples: int, seed: int) -> CandidateSimulations:
        """Return declared simulations without luck, replicated ones with it."""
        torch.manual_seed(seed)
        theta = PRIOR.sample((num_samples,))
        action = ACTIONS[:, None].expand(-1, num_samples, 1)
        rows = theta.expand(action.shape), action
        if self.luck == 0:
            mean = self.mean(*rows)
            x = mean + torch.randn_like(theta)
            return CandidateSimulations(theta, ACTIONS, x, mean, NOISE)
        return CandidateSimulations(theta, ACTIONS, self(*rows), replicate=self(*rows))

    @cache  # noqa: B019, three worlds live as long as the tests
    def exact(self) -> dict[str, Tensor]:
        """Return exact gains in nats, each of shape (a,).

        "counted" is the information of all outcomes; "validity" that of validity alone;
        "dropped" the mean of log p(theta | x) - log p(theta) over measurements, which
        forgets the others.
        """
        result: dict[str, list[float]] = {"counted": [], "validity": [], "dropped": []}
        x = torch.linspace(-50, 50, 2_501).double()
        for a in ACTIONS[:, 0].double():
            log_v = self.log_valid(GRID, a)
            p = log_v.exp()
            valid = (WEIGHT * p).sum()
            known = torch.special.xlogy(p, p / valid)
            known += torch.special.xlogy(1 - p, (1 - p) / (1 - valid))
            validity = WEIGHT @ known
            log_x = -0.5 * (x[:, None] - a * GRID) ** 2 - 0.5 * math.log(2 * math.pi)
            # E over measurements of log p(x | theta) - log p(x | valid)
            joint = WEIGHT * p / valid
            density = log_x.exp() @ joint
            entropy = -torch.special.xlogy(density, density).sum() * (x[1] - x[0])
            conditional = entropy - 0.5 * (math.log(2 * math.pi) + 1)
            tilt = joint @ torch.where(joint > 0, log_v - valid.log(), 0.0)
            result["counted"].append(float(validity + valid * conditional))
            result["validity"].append(float(validity))
            result["dropped"].append(float(conditional + tilt))
        return {name: torch.tensor(v).double() for name, v in result.items()}

    def log_posterior(self, theta: Tensor, x: Tensor, action: Tensor) -> Tensor:
        """Exact log density given a measurement or none, as a network's."""
        theta, x, action = theta.double(), x.double(), action.double()

        def log_joint(t: Tensor) -> Tensor:
            log_v = self.log_valid(t, action)
            lost = torch.log1p(-log_v.exp().clamp_max(1 - 1e-12))
            measured = log_v + log_normal(x - action * t)
            return torch.where(x.isnan(), lost, measured) + log_normal(t)

        step = float(GRID[1] - GRID[0])
        evidence = log_joint(GRID.expand(len(x), -1)).logsumexp(1) + math.log(step)
        return log_joint(theta)[:, 0] - evidence


def log_normal(z: Tensor) -> Tensor:
    """Standard normal log density."""
    return -0.5 * z**2 - 0.5 * math.log(2 * math.pi)


CERTAIN, LUCKY, LUCKIER = Fragile(0.0), Fragile(0.4), Fragile(1.5)
BY_LUCK = {
    True: [PosteriorGain(), ParameterGain()],
    False: [PosteriorGain(), EntropyGain(), NestedGain()],
}


def estimate(world, estimator, simulations):
    gain = estimator(world, simulations, PRIOR)
    return gain.nanmean(1), standard_error(gain)


def lose_rows(simulations, share, seed=0):
    """Faults that have nothing to do with the parameters."""
    generator = torch.Generator().manual_seed(seed)
    missing = torch.rand(simulations.x.shape[:2], generator=generator) < share
    lost = {
        name: part.masked_fill(missing[..., None], torch.nan)
        for name, part in simulations.parts().items()
    }
    return replace(simulations, missing=missing, **lost)


@pytest.mark.parametrize("world", [CERTAIN, LUCKIER], ids=["certain", "lucky"])
def test_every_estimator_counts_all_outcomes(world):
    exact = world.exact()["counted"]
    for estimator in BY_LUCK[world.luck > 0]:
        gain, error = estimate(world, estimator, world.simulations(700, 0))
        assert ((gain - exact).abs() < 3 * error).all()
        assert int(gain.argmax()) == int(exact.argmax())


@pytest.mark.parametrize("estimator", [EntropyGain(), NestedGain()])
def test_estimators_by_the_noise_do_not_count_presence_that_is_random(estimator):
    rows, exact = LUCKY.simulations(700, 0), LUCKY.exact()
    gain, error = estimate(LUCKY, estimator, rows)
    assert (gain < exact["counted"] + 3 * error).all()
    assert "measurement is random given the parameters" in estimator.problems(rows)[0]


def test_a_network_that_knows_validity_chooses_as_the_exact_posterior():
    """It is trained on all rows."""
    world = LUCKY
    generator = torch.Generator().manual_seed(0)
    action = ACTIONS[torch.randint(len(ACTIONS), (4_000,), generator=generator)]
    torch.manual_seed(0)
    theta = PRIOR.sample((4_000,))
    x = world(theta, action)
    network = MixtureDensity(hidden_features=(32,), num_iterations=400)
    inference = ASBI(PRIOR, network, show_progress_bars=False)
    inference.append_simulations(theta, x, action=action, belief=PRIOR).train()
    rows = replace(world.simulations(2_000, 1), replicate=None)
    gain = PosteriorGain()(inference.build_posterior(), rows, PRIOR)
    mean, error = gain.mean(1), standard_error(gain)
    assert int(mean.argmax()) == int(world.exact()["counted"].argmax()) == 2
    assert (mean < world.exact()["counted"] + 3 * error).all()  # a lower bound,
    assert mean[2] > world.exact()["validity"][2] + 3 * error[2]  # not trivial


@pytest.mark.parametrize("world", [CERTAIN, LUCKY], ids=["certain", "lucky"])
def test_dropping_invalid_rows_reverses_the_choice(world):
    """Negative control: log q - log p averaged over measurements alone."""
    exact = world.exact()
    assert int(exact["counted"].argmax()) == 2  # a push of 2
    assert int(exact["dropped"].argmax()) == 3  # the one that nearly always fails
    rows = replace(world.simulations(3_000, 0), replicate=None)
    gain = PosteriorGain()(world, rows, PRIOR)
    valid = rows.x[..., 0].isfinite()
    dropped = (gain * valid).sum(1) / valid.sum(1)
    pairs = zip(gain, valid, strict=True)
    error = torch.stack([standard_error(g[v]) for g, v in pairs])
    assert ((dropped - exact["dropped"]).abs() < 4 * error).all()
    assert int(dropped.argmax()) == 3
    assert dropped[3] > dropped[2] + 1.0


def test_missing_rows_are_dropped_and_not_invalid():
    for world in (CERTAIN, LUCKY):
        rows = lose_rows(world.simulations(600, 3), 0.4)
        for estimator in BY_LUCK[world.luck > 0]:
            gain = estimator(world, rows, PRIOR)
            assert torch.equal(gain.isnan(), rows.missing)
            mean, error = estimate(world, estimator, rows)
            slack = 0.25 if estimator.bound == "lower" else 0.0
            distance = mean - world.exact()["counted"]
            assert (distance < 4 * error).all()
            assert (distance > -slack - 4 * error).all()
        # negative control: counted as invalid they mislead
        wrong = replace(rows, missing=None)
        mean, error = estimate(world, PosteriorGain(), wrong)
        assert ((mean - world.exact()["counted"]).abs() > 6 * error).any()


def test_the_designer_tells_luck_from_a_function_of_the_parameters():
    designer = InformationGainDesigner(DiscreteActions(ACTIONS), num_samples=1_500)

    def select(world):
        model = SimulatorModel(world.mean, noise=NOISE)
        design = designer.select(None, model, belief=PRIOR, seed=0)
        distance = design.expected_information_gain - world.exact()["counted"]
        slack = 0.25 if design.bound == "lower" else 0.0
        assert (distance < 4 * design.standard_error).all()
        assert (distance > -slack - 4 * design.standard_error).all()
        assert design.action.tolist() == [2.0]
        return design

    certain, lucky = select(CERTAIN), select(LUCKY)
    assert (certain.notes, certain.bound) == ((), "none")
    assert (lucky.estimator, lucky.bound) == ("ParameterGain", "lower")
    assert "a measurement is random given the parameters" in lucky.notes[0]
    share = torch.distributions.Normal(0.0, 1.0).cdf(-0.3 * (ACTIONS[:, 0] - 2))
    error = (share * (1 - share) / (certain.num_samples)).sqrt()
    assert ((certain.probability_valid - share).abs() < 4 * error).all()


# Designs on simulators whose outcomes are invalid or missing


def falls_off(theta, action):
    """A measurement with a probability that falls with the push; some are partial."""
    x = linear_gaussian.simulator(theta, action)
    x[torch.rand(len(x)) < 0.5, 1] = torch.nan  # partly observed: a measurement
    lost = torch.rand(len(x), 1) < 0.3 * action
    return x.masked_fill(lost, torch.nan)


def test_a_measurement_that_is_too_improbable_excludes_an_action():
    sizes = {"num_samples": 2_000, "estimator": "posterior"}
    designer = InformationGainDesigner(pushes.ACTIONS, **sizes)

    class Model(linear_gaussian.ExactModel):
        def log_posterior(self, theta, x, action):
            known = x.isfinite()
            log_q = super().log_posterior(theta, x.nan_to_num(), action)
            return torch.where(known.all(1), log_q, self.belief.log_prob(theta))

    free = designer.select(Model(), falls_off, seed=0)
    exact = 1 - 0.3 * pushes.VALUES
    error = (exact * (1 - exact) / free.num_samples).sqrt()
    assert ((free.probability_valid - exact).abs() <= 4 * error).all()
    safe = designer.select(Model(), falls_off, min_probability_valid=0.6, seed=0)
    assert free.action.tolist() == [2.0]  # negative control
    assert safe.action.tolist() == [1.0]
    assert safe.probability_best[3] == 0
    assert safe.probability_best.sum() == pytest.approx(1.0)
    assert safe.expected_information_gain.isfinite().all()
    (note,) = safe.notes
    assert note.startswith("1 of 4 candidates excluded: a measurement is less probable")
    only_hard = InformationGainDesigner([1.5, 2.0], **sizes)
    with pytest.raises(ValueError, match=r"at least 0.9; got 0\.5\d* at most"):
        only_hard.select(Model(), falls_off, min_probability_valid=0.9, seed=0)


def test_missing_rows_are_counted_and_warned_of_once():
    def raises(theta, action, seeds):
        if bool((seeds % 25 == 0).any()):
            raise RuntimeError("licence server")
        return theta * action + row_normals(seeds, 1)

    actions = DiscreteActions([0.1, 4.0])
    designer = InformationGainDesigner(actions, num_samples=400)
    with pytest.warns(MissingRowsWarning, match="of the design are miss") as caught:
        design = designer.select(None, raises, belief=PRIOR, seed=0)
    assert len([w for w in caught if w.category is MissingRowsWarning]) == 1
    error = (0.04 / design.num_simulations) ** 0.5
    assert abs(design.num_missing / design.num_simulations - 0.04) < 3 * error


@pytest.mark.parametrize("declared", [True, False])
def test_a_rare_fault_stops_no_design(declared):
    """Rows were lost in one draw and not in the next, or all that were run again."""

    def fails(theta, action):
        if bool((theta > 2.5).any()):
            raise RuntimeError("diverged")
        return theta * action

    def noisy(theta, action):
        return fails(theta, action) + torch.randn_like(theta)

    model = SimulatorModel(fails, noise=1.0) if declared else noisy
    designer = InformationGainDesigner([1.0, 1.1], num_samples=400)
    lost = []
    for seed in range(3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)
            design = designer.select(None, model, belief=PRIOR, seed=seed)
        assert design.probability_valid.tolist() == [1.0, 1.0]
        lost.append(design.num_missing)
    assert 0 < max(lost) < 60
