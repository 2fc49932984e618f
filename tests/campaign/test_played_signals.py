"""A campaign whose actions are signals that a motor plays."""

import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign, GaussianNoise, SimulatorModel
from sbi_active.actions import SignalActions
from sbi_active.actions.waveforms import step
from tests.campaign.problem import OPTIONS

STEP = 0.05
GRID = torch.linspace(0, 1, 21)
TIMES = torch.linspace(0.1, 1.0, 10)
SPACE = SignalActions(
    step("voltage", begin=0.1),
    [0.2, 0.05],
    [2.0, 0.8],
    input_times=GRID,
    units=["V", "s"],
    duration=0.7,
)
PRIOR = BoxUniform(torch.tensor([1.0, 0.05]), torch.tensor([5.0, 0.5]))
TRUTH = torch.tensor([[3.0, 0.2]])


def speed(theta, action, *, inputs, times):
    """A first-order motor, tau w' = k u - w, on the grid of its voltage."""
    gain, tau = theta.unbind(1)
    keep = torch.exp(-STEP / tau)
    w, found = torch.zeros_like(gain), []
    for u in inputs["voltage"].unbind(1):
        found.append(w)
        w = keep * w + (1 - keep) * gain * u
    series = torch.stack(found, 1)
    return series.gather(1, (times / STEP).round().long())


MODEL = SimulatorModel(
    speed,
    noise=GaussianNoise(0.02),
    parameter_names=["gain", "tau"],
    sample_times=TIMES,
    inputs=SPACE,
)


def motor(action, seed):
    """The real one, which plays what it is given."""
    u = SPACE.inputs(action)["voltage"][None]
    x = speed(TRUTH, None, inputs={"voltage": u}, times=TIMES[None])[0]
    gen = torch.Generator().manual_seed(seed)
    return x + 0.02 * torch.randn(x.shape, generator=gen)


def test_a_campaign_asks_for_signals_and_learns():
    campaign = Campaign(MODEL, PRIOR, SPACE, options=OPTIONS, seed=0)
    trial = campaign.ask()
    assert bool(SPACE.contains(trial.action))
    assert SPACE.inputs(trial.action)["voltage"].shape == GRID.shape
    campaign.tell(motor(trial.action, 0))
    for k, action in enumerate(SPACE.sample((2,), seed=1), 1):
        campaign.attach(action, motor(action, k))
    campaign.update()
    mean, sd = campaign.belief.mean, campaign.belief.stddev
    assert bool(((mean - TRUTH[0]).abs() < 4 * sd + 0.01).all())
    assert bool((sd < torch.tensor([0.1, 0.02])).all())
    assert campaign.health == "ok"
