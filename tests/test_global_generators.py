"""Who leaves the global generators of torch and NumPy as they were: see seeding."""

import numpy as np
import pytest
import torch
from attrs import evolve
from scipy import stats

from sbi_active import GaussianNoise, estimate_noise, seeding, to_inference_data
from sbi_active.actions import BoxActions, MixedActions
from sbi_active.criticism import Trials, close_loop
from sbi_active.design import InformationGainDesigner, RandomDesigner
from sbi_active.inference import ALHI, ASBI, SeqBED, refine
from sbi_active.inference.rounds.rows import Observation
from sbi_active.simulation import SimulatorModel, check_simulator, simulate
from tests.campaign.problem import (
    ACTIONS,
    MODEL,
    OPTIONS,
    PRIOR,
    RATIOS,
    campaign,
    noisy,
)

THETA = torch.linspace(0.1, 0.9, 300)[:, None]
ACTION = ACTIONS.sample((300,), seed=0)
X = simulate(MODEL, THETA, ACTION, seed=0).x
REAL = torch.tensor([[1.0], [3.0], [0.5]]), torch.tensor([[0.6], [1.8], [0.3]])


def by_numpy(theta, action):
    return (theta * action).numpy() + 0.1 * np.random.randn(*theta.shape)


@pytest.fixture
def kept():
    """Return what checks that calls leave both generators as they were."""
    changed = []

    def check(name, call):
        before, numpy_before = torch.get_rng_state(), np.random.get_state()
        result = call()
        after = np.random.get_state()
        same = torch.equal(before, torch.get_rng_state())
        same &= (numpy_before[1] == after[1]).all() and numpy_before[2] == after[2]
        changed.extend([] if same else [name])
        return result

    yield check
    assert changed == []


def test_a_campaign(kept, few_draws):
    c = kept("Campaign", lambda: campaign("asbi", by_numpy, network="each round"))
    trial = kept("ask", c.ask)
    kept("tell", lambda: c.tell(0.6 * trial.action))
    kept("attach", lambda: c.attach([1.0], [0.6]))
    belief = kept("update", c.update)
    kept("health", lambda: c.health)
    kept("stop_reason", lambda: c.stop_reason)
    kept("mean", lambda: (belief.mean, belief.variance, repr(belief)))
    kept("log_prob", lambda: belief.log_prob(THETA))
    kept("criticize", lambda: c.criticize([], evaluate=False))
    kept("to_inference_data", lambda: to_inference_data(c, num_samples=20))
    kept("withdraw", lambda: c.withdraw(0))
    kept("again", c.update)


@pytest.mark.parametrize("make", [ASBI, ALHI, SeqBED])
def test_a_trainer_after_training(kept, make):
    network = RATIOS if make is SeqBED else OPTIONS.density_estimator
    network = evolve(network, num_iterations=5)
    trainer = make(PRIOR, network, show_progress_bars=False)
    trainer.append_simulations(THETA, X, action=ACTION, belief=PRIOR).train()
    model = kept("build_posterior", trainer.build_posterior)
    designer = InformationGainDesigner(ACTIONS, num_samples=100)
    kept("select", lambda: designer.select(model, MODEL, belief=PRIOR, seed=1))
    own = {"refinement": OPTIONS.refinement, "seed": 3}
    trials = [Observation(*pair) for pair in zip(*REAL, strict=True)]
    told = {"action": REAL[0][0], "simulator": MODEL} | own
    belief = kept("update", lambda: trainer.update(REAL[1][0], **told))
    kept("log_prob", lambda: belief.log_prob(THETA))
    kept("update_all", lambda: trainer.update_all(trials, MODEL, **own))


def test_designers_and_refinement(kept):
    box = BoxActions([0.1], [3.0])
    mixed = MixedActions(ACTIONS, BoxActions([0.0], [1.0]))
    for actions in (ACTIONS, box, mixed):
        kept("actions", lambda a=actions: a.sample((3,), seed=1))
    given = {"belief": PRIOR, "seed": 1}
    for actions in (ACTIONS, box):
        random = kept("RandomDesigner", lambda a=actions: RandomDesigner(a))
        kept("random", lambda d=random: d.select(None, MODEL, **given))
    designer = InformationGainDesigner(ACTIONS, num_samples=50)
    kept("select", lambda: designer.select(None, noisy, **given))
    settings = OPTIONS.refinement
    own = kept("refine", lambda: refine(noisy, PRIOR, *REAL, settings=settings, seed=1))
    kept("mean", lambda: (own.mean, own.diagnostics, repr(own)))


def test_simulators_and_noise(kept):
    for function in (noisy, by_numpy):
        model = kept("SimulatorModel", lambda f=function: SimulatorModel(f))
        kept("simulate", lambda m=model: simulate(m, THETA, ACTION, seed=0))
    kept("workers", lambda: simulate(MODEL, THETA, ACTION, seed=0, workers=2))
    seeds = torch.arange(len(THETA))
    kept("model", lambda: MODEL(THETA, ACTION, seeds=seeds))
    kept("mean", lambda: MODEL.mean(THETA, ACTION))
    kept("sample", lambda: GaussianNoise(0.1).sample(X, seeds))
    kept("derive_seed", lambda: seeding.derive_seed(0, "key"))
    kept("estimate_noise", lambda: estimate_noise(X[:40].reshape(4, 10, 1)))
    kept("check_simulator", lambda: check_simulator(noisy, PRIOR, ACTIONS, seed=0))


def test_a_report(kept):
    report = kept("close_loop", lambda: close_loop(MODEL, PRIOR, Trials(*REAL), seed=0))
    kept("str", lambda: str(report))


def test_what_draws_as_in_sbi_and_torch():
    """The exceptions that seeding names; a seed would be a change of their meaning."""
    c = campaign()
    c.tell(0.6, action=[1.0])
    belief = c.update()
    for call in (
        lambda: ASBI(PRIOR, show_progress_bars=False),
        lambda: belief.sample((3,)),
        lambda: MODEL(THETA, ACTION),
        lambda: ACTIONS.sample((3,)),
        lambda: SeqBED(PRIOR) and RandomDesigner(ACTIONS).select(None, belief=PRIOR),
    ):
        before = torch.get_rng_state()
        call()
        assert not torch.equal(before, torch.get_rng_state())


# Seeds of rows, and generators that are forked


def test_rows_depend_on_seed_and_index_alone():
    together = seeding.row_normals(seeding.row_seeds(3, 100), 4)
    apart = seeding.row_normals(seeding.row_seeds(3, 40, first=60), 4)
    assert torch.equal(together[60:], apart)
    assert not torch.equal(together, seeding.row_normals(seeding.row_seeds(4, 100), 4))


def test_row_uniforms_are_uniform_and_continue_the_stream():
    seeds = seeding.row_seeds(2, 20_000)
    draws = seeding.row_uniforms(seeds, 4)
    assert stats.kstest(draws.numpy().ravel(), "uniform").pvalue > 1e-3
    assert torch.equal(seeding.row_uniforms(seeds, 2, first=2), draws[:, 2:])
    assert torch.equal(seeding.row_uniforms(seeds[[7, 3]], 4), draws[[7, 3]])


def test_row_normals_are_those_of_the_uniforms_and_uncorrelated():
    seeds = seeding.row_seeds(1, 20_000)
    draws = seeding.row_normals(seeds, 5).numpy()
    normals = stats.norm.ppf(seeding.row_uniforms(seeds, 5).numpy())
    assert np.allclose(draws, normals, atol=1e-9)
    # Within a row, and along rows, whose seeds are neighbors.
    beside = np.corrcoef(draws.T)[np.triu_indices(5, 1)]
    along = np.corrcoef(draws[1:, 0], draws[:-1, 0])[0, 1]
    assert np.abs([*beside, along]).max() < 4 / np.sqrt(20_000)


def test_fork_seeds_inside_and_restores_outside():
    torch.manual_seed(5)
    np.random.seed(5)
    expected = torch.rand(1), np.random.rand()
    torch.manual_seed(5)
    np.random.seed(5)
    with seeding.forked_generators(1, "key"):
        first = torch.rand(3), np.random.rand(3)
    with seeding.forked_generators(1, "key"):
        second = torch.rand(3), np.random.rand(3)
    assert torch.equal(first[0], second[0])
    assert (first[1] == second[1]).all()
    assert (torch.rand(1), np.random.rand()) == expected
