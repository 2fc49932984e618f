"""Location finding: bounds against closed forms, beliefs, policies and roll-outs.

Tolerances are multiples of stated standard errors; seeds are fixed.
"""

import argparse
import csv
import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal

from benchmarks.location_finding import run as run_module
from benchmarks.location_finding.bounds import (
    contrastive_bounds,
    history_log_likelihood,
    near_cap,
    posterior_bounds,
    proposal_bounds,
)
from benchmarks.location_finding.particles import ParticleBelief
from benchmarks.location_finding.policies import POLICIES, Fixed, candidates
from benchmarks.location_finding.static_design import contrastive_bound, load, optimize
from benchmarks.location_finding.summary import difference, mean_and_error, table
from sbi_active import ASBI
from sbi_active.tasks import get_task
from sbi_active.tasks.location_finding.model import (
    NOISE_SD,
    log_likelihood,
    mean,
)


def normal(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def history(num_sources: int, num_trials: int, seed: int) -> tuple[Tensor, ...]:
    """Return a truth of the prior, random places and outcomes."""
    theta = normal(2 * num_sources, seed=seed)
    action = normal(num_trials, 2, seed=seed + 1)
    x = mean(theta[None, None], action)[0]
    return theta, action, x + NOISE_SD * normal(num_trials, 1, seed=seed + 2)


def grid_posterior(action: Tensor, x: Tensor) -> tuple[float, Tensor]:
    """Return log evidence and mean of one source by quadrature on a fine grid."""
    line = torch.linspace(-5, 5, 801, dtype=torch.float64)
    place = torch.cartesian_prod(line, line)
    log_joint = history_log_likelihood(place, action, x)
    log_joint += Normal(0, 1).log_prob(place).sum(1)
    log_evidence = log_joint.logsumexp(0) + 2 * (line[1] - line[0]).log()
    return float(log_evidence), log_joint.softmax(0) @ place


# ------------------------------------------------------------------ the bounds


def linear_gaussian(n: int, num_contrastive: int) -> tuple[Tensor, ...]:
    """Return log p(h|theta_0), log p(h|theta_l), log p(h) of x_t = a_t theta + noise.

    The information is .5 log(1 + sum a_t^2).
    """
    slope = torch.tensor([1.0, 2.0, -1.5], dtype=torch.float64)
    theta = normal(n, 1, seed=0)
    x = theta * slope + normal(n, 3, seed=1)
    other = normal(n, num_contrastive, 1, seed=2)
    log_p_true = Normal(theta * slope, 1).log_prob(x).sum(1)
    log_p = Normal(other * slope, 1).log_prob(x[:, None]).sum(2)
    covariance = torch.eye(3, dtype=torch.float64) + slope[:, None] * slope
    evidence = torch.distributions.MultivariateNormal(
        torch.zeros(3).double(), covariance
    )
    return theta, x, log_p_true, log_p, evidence.log_prob(x)


INFORMATION = 0.5 * math.log(1 + 1 + 4 + 2.25)


@pytest.mark.parametrize("num_contrastive", [5, 1_000])
def test_contrastive_bounds_bracket_the_linear_gaussian_information(num_contrastive):
    _, _, log_p_true, log_p, _ = linear_gaussian(4_000, num_contrastive)
    lower, upper = contrastive_bounds(log_p_true, log_p)
    error_lower, error_upper = (float(b.std()) / 4_000**0.5 for b in (lower, upper))
    assert float(lower.mean()) < INFORMATION + 3 * error_lower
    assert float(upper.mean()) > INFORMATION - 3 * error_upper
    assert bool((lower <= math.log(num_contrastive + 1)).all())
    if num_contrastive == 5:  # few draws: neither is the information
        assert float(lower.mean()) < INFORMATION - 5 * error_lower
        assert float(upper.mean()) > INFORMATION + 5 * error_upper
    else:
        assert float(lower.mean()) > INFORMATION - 4 * error_lower
        assert float(upper.mean()) < INFORMATION + 4 * error_upper


def test_contrastive_bounds_are_the_formulas():
    log_p_true, log_p = normal(4, seed=0), normal(4, 7, seed=1)
    lower, upper = contrastive_bounds(log_p_true, log_p)
    for i in range(4):
        truth, others = math.exp(log_p_true[i]), log_p[i].exp().tolist()
        with_truth = (truth + sum(others)) / 8
        assert float(lower[i]) == pytest.approx(math.log(truth / with_truth))
        assert float(upper[i]) == pytest.approx(math.log(truth / (sum(others) / 7)))


def test_contrastive_bounds_stand_deep_histories():
    lower, upper = contrastive_bounds(
        torch.tensor([-1e3]), torch.full((1, 10), -3e3, dtype=torch.float64)
    )
    assert float(lower) == pytest.approx(math.log(11))
    assert float(upper) == pytest.approx(2e3)


def test_the_posterior_as_proposal_leaves_no_gap():
    theta, x, log_p_true, _, log_evidence = linear_gaussian(50, 1)
    # Every draw of the posterior has the weight p(h).
    exact = (log_p_true - log_evidence)[:, None]
    lower, upper = proposal_bounds(
        log_p_true,
        -exact[:, 0],
        log_evidence[:, None].expand(50, 20),
        torch.zeros(50, 20),
    )
    torch.testing.assert_close(lower, exact[:, 0])
    torch.testing.assert_close(upper, exact[:, 0])


def test_a_narrow_proposal_still_gives_bounds():
    """With q of half the posterior's width, the bounds hold and have a gap."""
    theta, x, log_p_true, _, _ = linear_gaussian(4_000, 1)
    slope = torch.tensor([1.0, 2.0, -1.5], dtype=torch.float64)
    precision = 1 + slope.square().sum()
    q = Normal((x @ slope / precision)[:, None], 0.5 / precision.sqrt())
    draws = q.loc + q.scale * normal(4_000, 30, seed=5)
    log_p = Normal(draws[..., None] * slope, 1).log_prob(x[:, None]).sum(2)
    prior = Normal(0.0, 1.0)
    lower, upper = proposal_bounds(
        log_p_true,
        (prior.log_prob(theta) - q.log_prob(theta))[:, 0],
        log_p,
        prior.log_prob(draws) - q.log_prob(draws),
    )
    error = float(lower.std()) / 4_000**0.5, float(upper.std()) / 4_000**0.5
    assert float(lower.mean()) < INFORMATION + 3 * error[0]
    assert float(upper.mean()) > INFORMATION - 3 * error[1]
    assert float((upper - lower).mean()) > 0.02


def test_bounds_reject_histories_that_do_not_fit():
    with pytest.raises(ValueError, match=r"expected log_p_true \(n,\) and log_p"):
        contrastive_bounds(torch.zeros(3), torch.zeros(4, 5))


def test_near_cap():
    assert near_cap(math.log(1_001) - 0.5, 1_000)
    assert not near_cap(math.log(1_001) - 1.5, 1_000)


def test_posterior_bounds_of_one_source_are_the_quadrature_s():
    theta, action, x = history(1, 6, seed=10)
    log_evidence, _ = grid_posterior(action, x)
    exact = float(history_log_likelihood(theta[None], action, x)) - log_evidence
    belief = ParticleBelief(get_task("location_finding", num_sources=1), seed=0)
    for place, value in zip(action, x, strict=True):
        belief.update(place, value)
    lower, upper, effective = posterior_bounds(belief.theta, action, x, theta, seed=0)
    assert effective > 1_000
    assert lower == pytest.approx(exact, abs=4 / effective**0.5)
    assert upper == pytest.approx(exact, abs=4 / effective**0.5)


# ------------------------------------------------------------------ the beliefs


def test_particles_of_one_source_are_the_quadrature_s():
    _, action, x = history(1, 5, seed=20)
    log_evidence, expectation = grid_posterior(action, x)
    task = get_task("location_finding", num_sources=1)
    beliefs = [ParticleBelief(task, num_particles=500, seed=s) for s in range(8)]
    for belief in beliefs:
        for place, value in zip(action, x, strict=True):
            belief.update(place, value)
    evidence = torch.tensor([b.log_evidence for b in beliefs]).double()
    ratio = (evidence - log_evidence).exp()  # of mean 1
    assert abs(float(ratio.mean()) - 1) < 4 * float(ratio.std()) / 8**0.5
    means = torch.stack([b.theta.mean(0) for b in beliefs])
    error = means.std(0) / 8**0.5
    assert bool(((means.mean(0) - expectation).abs() < 4 * error).all())


def test_particles_keep_both_orders_of_the_sources():
    theta, action, x = history(2, 8, seed=30)
    belief = ParticleBelief(get_task("location_finding"), num_particles=1_000, seed=0)
    for place, value in zip(action, x, strict=True):
        belief.update(place, value)
    share = float((belief.theta[:, 0] > belief.theta[:, 2]).double().mean())
    assert abs(share - 0.5) < 4 * 0.5 / 1_000**0.5
    log_prob = belief.log_prob(torch.stack([theta, theta[[2, 3, 0, 1]]]).float())
    assert float(log_prob[0]) == pytest.approx(float(log_prob[1]), abs=1e-3)


def test_refined_belief_is_the_exact_posterior():
    theta, action, x = history(2, 4, seed=40)
    task = get_task("location_finding")
    inference = ASBI(task.prior, show_progress_bars=False)
    for t in range(4):
        belief = inference.update(
            x[t].float(), action=action[t].float(), simulator=task.simulator, seed=t
        )
    draws = normal(200_000, 4, seed=43)
    log_p = history_log_likelihood(draws, action, x)
    log_evidence = log_p.logsumexp(0) - math.log(len(draws))
    weight = (log_p - log_p.logsumexp(0)).exp()
    exact = task.prior.log_prob(theta.float()) - log_evidence
    exact += history_log_likelihood(theta[None], action, x)[0]
    sizes = belief.diagnostics.effective_sample_size, 1 / weight.square().sum()
    error = math.sqrt(sum(1 / float(size) for size in sizes))
    assert error < 0.1
    assert abs(float(belief.log_prob(theta) - exact)) < 4 * error


def test_particles_reject_an_odd_number():
    with pytest.raises(ValueError, match="expected an even num_particles >= 100"):
        ParticleBelief(get_task("location_finding"), num_particles=101, seed=0)


# ------------------------------------------------------------------ the policies


def test_candidates_crowd_where_sources_may_be():
    belief = Normal(torch.tensor([2.0, 0.0, -2.0, 0.0]), 0.05)
    places = candidates(belief, 80, seed=1)
    assert places.shape == (80, 2)
    assert torch.equal(places, candidates(belief, 80, seed=1))
    sources = torch.tensor([[2.0, 0.0], [-2.0, 0.0]])
    close = torch.cdist(places, sources).amin(1) < 0.5
    assert 0.7 < float(close.double().mean()) < 1  # and some of them anywhere


def test_static_bound_is_the_contrastive_bound_of_its_histories():
    place, theta, noise = (
        normal(3, 2, seed=0),
        normal(6, 4, seed=1),
        normal(2, 3, seed=2),
    )
    value = contrastive_bound(place, theta, noise, 2)
    expected = []
    for i in range(2):
        x = mean(theta[i][None, None], place)[0] + NOISE_SD * noise[i][:, None]
        log_p = log_likelihood(x, theta[:, None], place).sum(1)
        expected.append(log_p[i] - log_p.logsumexp(0) + math.log(6))
    assert float(value) == pytest.approx(float(torch.stack(expected).mean()))


def test_the_static_design_tells_more_than_random_places(capsys):
    theta, noise = normal(2_000, 4, seed=1), normal(500, 30, seed=2)
    fixed = contrastive_bound(load().double(), theta, noise, 500)
    random = contrastive_bound(1.5 * normal(30, 2, seed=3), theta, noise, 500)
    assert float(fixed) > float(random)
    short = optimize(2, num_steps=3, num_histories=8, num_contrastive=16)
    assert short.shape == (2, 2)
    assert "step 0" in capsys.readouterr().out


def test_the_static_design_ends():
    fixed = Fixed(get_task("location_finding"), 0)
    for index in range(30):
        assert torch.equal(fixed.choose(), load()[index])
        fixed.tell(fixed.choose(), torch.zeros(1))
    with pytest.raises(ValueError, match="expected at most 30 trials.*trial 31"):
        fixed.choose()


# ------------------------------------------------------------------ the roll-outs


@pytest.mark.parametrize("policy", ["random", "fixed"])
def test_static_roll_outs_are_reproducible(policy):
    row, again = (run_module.roll_out(policy, 3, 2, 2_000) for _ in range(2))
    assert row["lower"] == again["lower"]
    assert row["places"] == again["places"]
    assert row["spce"] <= math.log(2_001)
    assert row["theta_true"] == run_module.roll_out("random", 3, 1, 10)["theta_true"]


@pytest.mark.parametrize(("policy", "trials"), [("myopic", 2), ("myopic_particles", 1)])
def test_myopic_roll_outs_share_the_truth_and_know_what_they_gained(policy, trials):
    row = run_module.roll_out(policy, 3, trials, 1_000)
    assert row["theta_true"] == run_module.roll_out("random", 3, 1, 10)["theta_true"]
    assert row["num_simulations"] > 1_000
    assert abs(row["belief_gain"] - row["lower"]) < 0.5
    # Two log means of draws of which so many are effective.
    assert row["lower"] <= row["upper"] + 4 / row["effective"] ** 0.5


@pytest.mark.slow
def test_myopic_gains_more_than_random():
    gains = {
        policy: torch.tensor(
            [run_module.roll_out(policy, i, 8, 100)["lower"] for i in range(8)]
        )
        for policy in ("random", "myopic_particles")
    }
    lead = gains["myopic_particles"] - gains["random"]
    assert float(lead.mean()) > 2 * float(lead.std()) / 8**0.5


def test_run_goes_on_where_it_stopped(tmp_path, capsys):
    def rows(rollouts: int) -> list[str]:
        arguments = argparse.Namespace(
            trials=1, contrastive=100, first=0, rollouts=rollouts, out=tmp_path
        )
        run_module.run("random", arguments)
        with (tmp_path / "random_1_L100.csv").open(newline="") as file:
            return [row["rollout"] for row in csv.DictReader(file)]

    assert rows(2) == ["0", "1"]
    capsys.readouterr()
    assert rows(3) == ["0", "1", "2"]
    assert capsys.readouterr().out.count("information in") == 1
    text = table(tmp_path, 1, 100)
    assert "random (3)" in text
    assert "Foster" not in text  # published for 30 trials


def test_differences_are_paired_and_conservative():
    better = {0: {"lower": 5.0, "upper": 6.0}, 1: {"lower": 7.0, "upper": 8.0}}
    worse = {1: {"lower": 2.0, "upper": 3.0}, 0: {"lower": 1.0, "upper": 2.0}}
    worse[2] = {"lower": 9.0, "upper": 9.0}  # not in common
    mean_lead, error, num = difference(better, worse)
    assert (mean_lead, num) == (3.5, 2)
    assert error == pytest.approx(0.5)
    assert math.isnan(mean_and_error(torch.ones(1).numpy())[1])


def test_policies_are_listed():
    assert [*POLICIES] == ["random", "fixed", "myopic", "myopic_particles"]
