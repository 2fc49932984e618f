"""Attacks on campaigns: bad measurements, odd priors, actions and settings."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cloudpickle
import numpy as np
import torch
from sbi.utils import BoxUniform
from torch.distributions import Gamma, Independent, Normal

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.campaign_outcomes import ATTACKS as OUTCOMES
from benchmarks.robustness.campaign_problem import (
    ACTIONS,
    METHODS,
    MODEL,
    OPTIONS,
    PRIOR,
    TRUTH,
    campaign,
    doubted,
    draws,
    noisy,
    refused,
    right,
    same,
    tell,
)
from sbi_active import (
    BoxActions,
    Campaign,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
    to_inference_data,
)
from sbi_active.campaign import StopRules
from sbi_active.campaign.options import CampaignDetails
from sbi_active.inference import LFIRE

ATTACKS = Attacks(OUTCOMES)


@ATTACKS.add(
    "torch's modes without gradients",
    cases=[
        (m, mode)
        for m in ("asbi", "alhi", "seqbed")
        for mode in ("no_grad", "inference_mode")
    ],
)
def modes(case: tuple[str, str]) -> None:
    method, mode = case
    results = []
    for context in (contextlib.nullcontext(), getattr(torch, mode)()):
        with context:
            prior = BoxUniform(torch.zeros(1), torch.ones(1))
            c = campaign(method, prior=prior, actions=DiscreteActions([0.5, 3.0]))
            for _ in range(2):
                c.tell(torch.tensor([TRUTH]) * c.ask().action)
            c.update()
        results.append((draws(c), c.ask().action))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@ATTACKS.add("a search by gradient without gradients", cases=("no_grad",))
def gradient_search(mode: str) -> None:
    with getattr(torch, mode)():
        c = campaign("asbi", actions=BoxActions([0.1], [3.0]))
        assert float(c.ask().action) > 2.0


PRIORS: dict[str, Callable[[], Any]] = {
    "low == high": lambda: BoxUniform(torch.ones(1), torch.ones(1)),
    "1e-9 wide": lambda: BoxUniform(torch.ones(1), torch.ones(1) + 1e-9),
    "1e-9 wide, float64": lambda: BoxUniform(
        torch.ones(1).double(), torch.ones(1).double() + 1e-9
    ),
    "1e-6 wide": lambda: BoxUniform(torch.ones(1), torch.ones(1) + 1e-6),
    "normal": lambda: Independent(Normal(torch.ones(1), 1e-9 * torch.ones(1)), 1),
    "low > high": lambda: BoxUniform(torch.ones(1), torch.zeros(1)),
    "NaN": lambda: BoxUniform(torch.zeros(1), torch.full((1,), torch.nan)),
    "inf": lambda: BoxUniform(torch.zeros(1), torch.full((1,), torch.inf)),
}


@ATTACKS.add("a prior without width", cases=[*PRIORS])
def no_width(name: str) -> None:
    with refused("expected"):
        campaign(prior=PRIORS[name]())


@ATTACKS.add("a prior of another scale", cases=(1e-30, 1e-6, 1e6, 1e20))
def scales(scale: float) -> None:
    model = SimulatorModel(lambda t, a: t / scale * a, noise=GaussianNoise(0.1))
    c = campaign(
        simulator=model, prior=BoxUniform(torch.zeros(1), torch.ones(1) * scale)
    )
    c.tell(TRUTH * 3.0, action=[3.0])
    c.update()
    assert abs(float(draws(c).median()) / scale - TRUTH) < 0.1


@ATTACKS.add("a prior of another family", cases=("normal", "gamma", "float64"))
def families(name: str) -> None:
    prior = {
        "normal": Independent(Normal(torch.zeros(1), torch.ones(1)), 1),
        "gamma": Independent(Gamma(torch.ones(1), torch.ones(1)), 1),
        "float64": BoxUniform(torch.zeros(1).double(), torch.ones(1).double()),
    }[name]
    c = tell(campaign(prior=prior))
    c.update()
    right(c)


@ATTACKS.add("an outcome of no numbers", cases=("n x 0",))
def no_numbers(_: str) -> None:
    with refused("expected outcomes with numbers"):
        campaign(simulator=lambda theta, action: torch.zeros(len(theta), 0))


@ATTACKS.add(
    "the global generators are left alone",
    cases=[(m, kind) for m in METHODS for kind in ("model", "draw")],
)
def generators(case: tuple[str, str]) -> None:
    method, kind = case
    before = torch.get_rng_state()
    numpy_before: Any = np.random.get_state()
    c = campaign(method, MODEL if kind == "model" else noisy)
    for _ in range(2):
        c.tell(TRUTH * c.ask().action)
    c.update()
    c.criticize([], evaluate=False)
    c.withdraw(0)
    to_inference_data(c.update() and c, num_samples=10)
    assert torch.equal(before, torch.get_rng_state())
    after: Any = np.random.get_state()
    assert (numpy_before[1] == after[1]).all()
    assert numpy_before[2] == after[2]


@ATTACKS.add("other global seeds, the same campaign", cases=METHODS)
def global_seeds(method: str) -> None:
    found: list[tuple[torch.Tensor, torch.Tensor]] = []
    for state in (1, 2):
        torch.manual_seed(state)
        np.random.seed(state)
        c = tell(campaign(method, noisy, seed=3))
        c.update()
        found.append((draws(c), c.ask().action))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@ATTACKS.add("a campaign goes through a pickle", cases=("nsbi", "alhi", "doubted"))
def pickled(case: str) -> None:
    c = tell(campaign("alhi" if case == "alhi" else "nsbi"))
    if case == "doubted":
        c.tell(1e15, action=[1.0])
    c.update()
    copy = cloudpickle.loads(cloudpickle.dumps(c))
    assert torch.equal(draws(c), draws(copy))
    if case == "doubted":
        doubted(copy, 3)
    assert torch.equal(c.ask().action, copy.ask().action)


@ATTACKS.add(
    "the real system fails",
    cases=("raises", "returns None", "returns NaN", "returns inf", "interrupt"),
)
def real_system_fails(case: str) -> None:
    c = campaign()

    def system(action: torch.Tensor) -> Any:
        if case == "raises":
            raise RuntimeError("the gripper is stuck")
        if case == "interrupt":
            raise KeyboardInterrupt
        return {"returns NaN": torch.nan, "returns inf": torch.inf}.get(case)

    with contextlib.suppress(RuntimeError, KeyboardInterrupt, ValueError):
        c.run(system, num_rounds=1)
    if case in ("returns NaN", "returns inf"):
        assert c.history[0].status == "invalid"
    else:
        assert c.pending is not None
    c.run(lambda action: TRUTH * action, num_rounds=2)
    right(c, 0.3)


@ATTACKS.add(
    "the simulator fails in a campaign", cases=("raises once", "raises now and then")
)
def simulator_fails(case: str) -> None:
    calls = {"bad": False}

    def flaky(theta: torch.Tensor, action: torch.Tensor, seeds: Any) -> torch.Tensor:
        if calls["bad"] or (case != "raises once" and bool((seeds % 50 == 0).any())):
            raise RuntimeError("licence server")
        generator = torch.Generator().manual_seed(int(seeds[0]))
        return theta * action + 0.1 * torch.randn(theta.shape, generator=generator)

    c = campaign(simulator=flaky)
    if case == "raises once":
        tell(c)
        calls["bad"] = True
        with contextlib.suppress(RuntimeError):
            c.update()
        calls["bad"] = False
    c = c if c.history else tell(c)
    c.update()
    right(c)


@ATTACKS.add(
    "settings that are wrong", cases=("method", "rows", "scored", "sd", "seed")
)
def wrong_settings(case: str) -> None:
    with refused("expected", "; got"):
        if case == "method":
            campaign("nbi")
        if case == "rows":
            replace(OPTIONS, num_simulations=3)
        if case == "scored":
            replace(OPTIONS, details=CampaignDetails(num_scored=3))
        if case == "sd":
            StopRules(max_sd=-1.0)
        if case == "seed":
            campaign(seed=-1)


@ATTACKS.add("LFIRE meets an outcome that nothing explains", cases=(62.0, 1e30))
def lfire(bad: float) -> None:
    options = replace(
        OPTIONS, density_estimator=LFIRE(), num_simulations=600, refine=False
    )
    c = Campaign(MODEL, PRIOR, ACTIONS, method="seqbed", options=options)
    tell(c, {1: bad})
    c.update()
    doubted(c, 1)
    right(c, 0.25)


@ATTACKS.add("two workers see the same campaign", cases=("nsbi", "bad number"))
def workers(case: str) -> None:
    bad = {1: 1e15} if case == "bad number" else {}
    one, two = (tell(campaign(workers=n), bad) for n in (1, 2))
    same(one, two)


@ATTACKS.add("a stated belief is used as a prior", cases=("sample", "log_prob"))
def stated_belief(case: str) -> None:
    c = campaign()
    c.tell(1e15, action=[1.0])
    belief = c.update()
    if case == "sample":
        assert abs(float(draws(c).mean()) - 0.5) < 0.06
    else:
        theta = torch.tensor([[0.5], [1.5]])
        assert belief.log_prob(theta).tolist() == [0.0, -torch.inf]
    assert c.update() is belief
