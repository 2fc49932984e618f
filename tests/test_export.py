import warnings

import arviz as az
import matplotlib
import numpy as np
import pytest
import torch
import xarray as xr
from sbi.utils import BoxUniform

from sbi_active import to_datatree, to_inference_data
from sbi_active.actions import BoxActions, DiscreteActions
from sbi_active.campaign import Campaign
from sbi_active.criticism import Trials, close_loop, generic_effects
from sbi_active.simulation import GaussianNoise, SimulatorModel
from tests.campaign.problem import OPTIONS

matplotlib.use("Agg")
PRIOR = BoxUniform(torch.zeros(2), torch.ones(2))


@pytest.fixture(scope="module")
def campaign():
    names = {"parameter_names": ["mass", "friction"], "channel_names": ["x", "y"]}
    model = SimulatorModel(lambda t, a: t * a, noise=0.2, **names)
    actions = DiscreteActions([1.0, 2.0], names=["push"])
    c = Campaign(model, PRIOR, actions, method="nsbi", options=OPTIONS)
    for _ in range(3):
        c.ask()
        c.tell([0.5, 0.4])
    c.ask()
    c.tell(status="missing")
    c.update()
    return c


def test_a_campaign_has_the_groups_and_coordinates(campaign):
    data = to_inference_data(campaign, num_samples=100)
    expected = "posterior prior posterior_predictive observed_data constant_data "
    expected += "sample_stats log_likelihood prior_predictive"
    assert {*data.groups()} == {*expected.split()}
    assert [*data.posterior.parameter.values] == ["mass", "friction"]
    assert data.posterior_predictive.x.shape == (4, 25, 3, 2)
    assert data.posterior_predictive.x.dims[2:] == ("round", "channel")
    assert [*data.observed_data["round"].values] == [1, 2, 3]
    assert [*data.constant_data.action_entry.values] == ["push"]


def test_the_log_likelihood_belongs_to_the_draws(campaign):
    data = to_inference_data(campaign, num_samples=10, num_chains=1)
    theta = torch.tensor(data.posterior.theta.values[0])
    action = torch.tensor(data.constant_data.action.values)
    x = torch.tensor(data.observed_data.x.values)
    for r in range(3):
        mean = theta * action[r]
        expected = torch.distributions.Normal(mean, 0.2).log_prob(x[r]).sum(-1)
        found = data.log_likelihood.x.values[0, :, r]
        assert found == pytest.approx(expected.numpy(), rel=1e-4)


def test_arviz_reads_it(campaign, tmp_path):
    data = to_inference_data(campaign, num_samples=200)
    summary = az.summary(data, kind="stats")
    assert [*summary.index] == ["theta[mass]", "theta[friction]"]
    mean = campaign.belief.mean.numpy()
    sd = campaign.belief.variance.sqrt().numpy()
    # rounding to three digits, and the standard error of 200 draws
    assert (np.abs(summary["mean"] - mean) < 5 * sd / 200**0.5 + 1e-3).all()
    az.plot_pair(data, var_names=["theta"])
    assert np.isfinite(az.loo(data, var_name="x").elpd_loo)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert az.summary(data)["r_hat"].between(0.98, 1.05).all()
    path = str(tmp_path / "data.nc")
    data.to_netcdf(path)
    assert az.from_netcdf(path).posterior.theta.shape == (4, 50, 2)


def test_a_belief_predicts_outcomes_at_actions(campaign):
    action = torch.tensor([[1.0], [1.5]])
    x = torch.tensor([[0.5, 0.4], [0.7, 0.6]])
    model = campaign.simulator
    tried = {"simulator": model, "action": action, "x": x}
    data = to_inference_data(campaign.belief, num_samples=2_000, **tried)
    predicted = data.posterior_predictive.x
    assert [*predicted.channel.values] == ["x", "y"]
    # Linear with a noise of .2: mean and variance follow from the draws.
    theta = data.posterior.theta.values.reshape(-1, 1, 2)
    rows = predicted.values.reshape(-1, 2, 2)
    expected = (theta * action.numpy()).mean(0)
    sd = ((theta * action.numpy()).var(0) + 0.2**2) ** 0.5
    assert (np.abs(rows.mean(0) - expected) < 5 * sd / 2_000**0.5).all()
    assert rows.std(0) == pytest.approx(sd, rel=5 / 4_000**0.5)
    assert np.allclose(data.observed_data.x, x)
    assert az.plot_ppc(data, num_pp_samples=10, random_seed=0) is not None
    bare = to_inference_data(PRIOR, simulator=model, action=action, num_samples=20)
    assert {"posterior_predictive", "constant_data"} < {*bare.groups()}
    assert not {"observed_data", "log_likelihood"} & {*bare.groups()}


@pytest.fixture(scope="module")
def report():
    given = {"noise": GaussianNoise(0.1), "parameter_names": ["gain"]}
    model = SimulatorModel(lambda theta, action: theta * action, **given)
    prior = BoxUniform(torch.zeros(1), 2 * torch.ones(1))
    action = torch.linspace(0.5, 2.0, 40)[:, None]
    actions = BoxActions([0.5], [2.0], names=["push"], units=["N"])
    effects = generic_effects(model, actions)
    few = [e for e in effects if "offset" in e.name or "bias" in e.name]
    trials = Trials(action, 0.8 * action + 0.2)
    options = {"effects": few, "evaluate": False, "plan": False, "seed": 0}
    return close_loop(model, prior, trials, actions=actions, **options)


def test_rivals_of_a_report_are_compared(report):
    name = str(report.tracing.key)
    assert name != "none"
    rivals = {m: to_inference_data(report, model=m) for m in ("none", name)}
    assert rivals[name].posterior.theta.shape[0] == 4
    assert rivals[name].posterior.attrs["verdict"] == report.verdict
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "The inplace keyword")  # ArviZ's own
        ranked = az.compare(rivals)
    assert ranked.index[0] == name
    with pytest.raises(ValueError, match="expected a model among"):
        to_inference_data(report, model="gremlins")


def test_a_rival_has_the_posterior_that_its_densities_go_with(report):
    """Whose intervals the report widens, since another model explains the trials."""
    own = report.tracing.evidences["none"]
    assert own.draws.std() > 5 * own.narrow.std()
    draws = to_inference_data(report, model="none").posterior.theta.values.ravel()
    assert draws.std() == pytest.approx(own.narrow.std(), rel=0.1)
    assert draws.mean() == pytest.approx(own.narrow.mean(), abs=0.1 * draws.std())
    assert len(np.unique(draws)) > 0.9 * len(draws)  # a resample repeats its points


def test_a_tree_is_read_again(campaign, tmp_path):
    with pytest.raises(TypeError, match="got float"):
        to_inference_data(1.0)
    tree = to_datatree(campaign, num_samples=40)
    tree.to_netcdf(tmp_path / "tree.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as again:
        assert again["posterior"]["theta"].dims == ("chain", "draw", "parameter")
        assert again["constant_data"]["action"].attrs == {}
        assert (again["observed_data"]["x"] == tree["observed_data"]["x"]).all()
