import pytest
import torch

from sbi_active import DiscreteActions, InformationGainDesigner, RandomDesigner
from sbi_active.actions import ActionSpace
from sbi_active.designer import DRAWS, _probability_best
from tests.linear_gaussian import PRIOR, ExactModel, information, simulator

VALUES = torch.tensor([0.0, 0.5, 1.0, 2.0])
ACTIONS = DiscreteActions(VALUES, names=["push"], units=["m/s"])


def test_it_finds_the_action_that_tells_most():
    designer = InformationGainDesigner(ACTIONS, num_samples=2_000)
    design = designer.select(ExactModel(), simulator, seed=0)
    assert design.action.tolist() == [2.0]
    assert design.index == 3
    assert torch.equal(design.candidates, VALUES[:, None])
    assert design.bound == "lower"
    assert design.num_simulations == 8_000
    z = (design.expected_information_gain - information(VALUES[:, None])) / (
        design.standard_error
    )
    assert (z[1:].abs() < 4).all()
    assert design.probability_best.sum() == pytest.approx(1.0)
    assert design.probability_best[3] > 0.99
    assert (design.probability_valid == 1).all()


def test_an_uninformative_action_has_no_gain():
    design = InformationGainDesigner(ACTIONS).select(ExactModel(), simulator, seed=0)
    assert float(design.expected_information_gain[0]) == pytest.approx(0.0, abs=1e-6)


def test_the_choice_and_the_report_use_separate_simulations():
    """With equal candidates the best of the choosing half regresses in the report."""
    equal = DiscreteActions(torch.full((40,), 1.0))
    designer = InformationGainDesigner(equal, num_samples=40)
    exact = float(information(torch.ones(1, 1)))
    errors = []
    for seed in range(60):
        design = designer.select(ExactModel(), simulator, seed=seed)
        errors.append(float(design.expected_information_gain[design.index]) - exact)
    errors = torch.tensor(errors)
    standard_error = float(errors.std() / len(errors) ** 0.5)
    assert abs(float(errors.mean())) < 4 * standard_error
    # negative control: the largest of the reported estimates is too large
    best = [
        float(
            designer.select(
                ExactModel(), simulator, seed=seed
            ).expected_information_gain.max()
        )
        for seed in range(10)
    ]
    assert min(best) > exact


def test_paired_errors_are_smaller_where_candidates_are_alike():
    close = DiscreteActions([1.9, 2.0])

    def common_noise(theta, action):
        generator = torch.Generator().manual_seed(0)
        return action * theta + torch.randn(theta.shape, generator=generator)

    def two_seeds(theta, action):  # the designer checks that x depends on the seed
        return common_noise(theta, action) + 1e-3 * torch.randn_like(theta)

    design = InformationGainDesigner(close, num_samples=1_024).select(
        ExactModel(), two_seeds, seed=0
    )
    other = 1 - design.index
    paired = design.difference_standard_error
    assert paired[design.index] == 0
    assert paired[other] < 0.5 * design.standard_error[other]


def test_probability_best_follows_the_central_limit():
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(2, 400, generator=generator, dtype=torch.float64)
    noise = (noise - noise.mean(1, keepdim=True)) / noise.std(1, keepdim=True)
    difference = 2 / 400**0.5  # two standard errors of one mean
    contributions = noise + torch.tensor([[0.0], [difference]])
    variance = float((noise[1] - noise[0]).var())
    expected = torch.distributions.Normal(0, variance**0.5).cdf(torch.tensor(2.0))
    assert float(_probability_best(contributions, 0)[1]) == pytest.approx(
        float(expected), abs=4 * (0.25 / DRAWS) ** 0.5
    )


def test_a_blunt_model_gives_a_lower_bound():
    designer = InformationGainDesigner(ACTIONS, num_samples=4_000)
    blunt = designer.select(ExactModel(spread=3.0), simulator, seed=0)
    exact = information(VALUES[:, None])
    assert (blunt.expected_information_gain < exact - 3 * blunt.standard_error).all()


def test_same_seed_same_design():
    designer = InformationGainDesigner(ACTIONS, num_samples=100)
    a, b = (designer.select(ExactModel(), simulator, seed=5) for _ in range(2))
    assert torch.equal(a.expected_information_gain, b.expected_information_gain)
    c = designer.select(ExactModel(), simulator)
    assert not torch.equal(a.expected_information_gain, c.expected_information_gain)


def test_invalid_outcomes_count():
    def fails_for_large_actions(theta, action):
        x = simulator(theta, action)
        return torch.where(action > 1.5, torch.nan, x)

    class Model(ExactModel):
        def log_posterior(self, theta, x, action):
            log_q = super().log_posterior(theta, x, action)
            return torch.where(x.isnan().any(1), PRIOR.log_prob(theta), log_q)

    designer = InformationGainDesigner(ACTIONS, num_samples=500)
    design = designer.select(Model(), fails_for_large_actions, seed=0)
    assert design.probability_valid.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert design.action.tolist() == [1.0]


def test_random_designs_are_uniform_and_seeded():
    designer = RandomDesigner(ACTIONS)
    chosen = torch.stack([designer.select(seed=s).action for s in range(800)])
    share = (chosen == VALUES).double().mean(0)
    assert ((share - 0.25).abs() < 4 * (0.25 * 0.75 / 800) ** 0.5).all()
    design = designer.select(seed=3)
    assert torch.equal(design.action, designer.select(seed=3).action)
    assert design.expected_information_gain.isnan().all()
    assert design.num_simulations == 0


def test_plot_names_the_action():
    design = InformationGainDesigner(ACTIONS, num_samples=40).select(
        ExactModel(), simulator, seed=0
    )
    ax = design.plot()
    assert ax.get_xlabel() == "push [m/s]"
    assert ax.get_ylabel() == "EIG (lower bound) [nats]"
    pairs = DiscreteActions([[0.0, 1.0], [1.0, 2.0]])
    assert RandomDesigner(pairs).select(seed=0).plot().get_xlabel() == "candidate"


def test_errors():
    with pytest.raises(ValueError, match="expected num_samples >= 4"):
        InformationGainDesigner(ACTIONS, num_samples=2)
    designer = InformationGainDesigner(ACTIONS, num_samples=10)

    class NoBelief:
        def log_posterior(self, theta, x, action):
            return theta[:, 0]

    with pytest.raises(ValueError, match="expected belief="):
        designer.select(NoBelief(), simulator)
    with pytest.raises(ValueError, match="got identical x from two seeds"):
        designer.select(ExactModel(), lambda t, a: t * a)

    class Ball(ActionSpace):
        action_dim = 1

        def sample(self, sample_shape, *, seed=None):
            return torch.zeros(*sample_shape, 1)

        def contains(self, action):
            return torch.ones(action.shape[:-1]).bool()

    with pytest.raises(TypeError, match="expected DiscreteActions; got Ball"):
        InformationGainDesigner(Ball())
