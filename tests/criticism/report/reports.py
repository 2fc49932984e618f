"""Reports with figures that are made up, to test how they are told."""

from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials, results
from sbi_active.criticism.contradictions import Misfit, ModelError, Support
from sbi_active.criticism.report.report import build_report
from tests.effects import on_outcomes

DRAG = on_outcomes("drag", lambda x, phi, action, context: x - phi)
NAMES = ["drag", "tilt", "bias"]
SHUFFLED = [2.0, -1.0, 3.0, 1.0, -2.0, -3.0, 1.5, -1.5, 2.5]


def evidence(name: str, log_evidence: float) -> results.Evidence:
    rng = np.random.default_rng(0)
    names = ("mu_1", "mu_2") if name == "none" else ("mu_1", "mu_2", name)
    return results.Evidence(
        key=results.ModelKey.of(name),
        log_evidence=log_evidence,
        standard_error=0.05,
        effective_sample_size=312.0,
        engine="least squares",
        names=names,
        draws=0.3 + 0.01 * rng.normal(size=(400, len(names))),
    )


def estimate(name: str, probability: float, **changes) -> results.Estimate:
    made = results.Estimate(
        name=name,
        family="dynamics",
        units="1/m",
        describe="a force against the speed" if name == "drag" else "",
        probability=probability,
        log_bayes_factor=9.4,
        mean=np.array([0.123]),
        sd=np.array([0.011]),
        engine="least squares",
    )
    return replace(made, **changes)


def tracing(verdict: str = "drag", **changes) -> results.Tracing:
    probabilities = {"none": 0.004, "unexplained": 0.01, "scatter": 0.001}
    probabilities |= {"drag": 0.81, "tilt": 0.125, "bias": 0.05}
    chosen = (verdict,) if verdict in NAMES else ()
    made = results.Tracing(
        verdict=verdict,
        chosen=chosen,
        probabilities=probabilities,
        inclusion={"drag": 0.81, "tilt": 0.125, "bias": 0.05},
        credible_set=("drag", "tilt"),
        equivalent=(),
        estimates=tuple(estimate(n, probabilities[n]) for n in NAMES),
        evidences={n: evidence(n, -3.0) for n in ["none", *NAMES, "unexplained"]},
    )
    return replace(made, **changes)


def misfit(left_out, held_out=(None, None), *, sensor=(0.005,)) -> Misfit:
    """Return models that miss, by errors of the bare one and of that with drag."""
    models = tuple(
        ModelError(
            name=name,
            probability=float(name == "drag"),
            left_out=np.atleast_1d(left),
            held_out=None if held is None else np.atleast_1d(held),
            remains=0.9,
        )
        for name, left, held in zip(("none", "drag"), left_out, held_out, strict=True)
    )
    return Misfit(
        models=models,
        helps=("drag",),
        named=(),
        support={"drag": Support(inclusion=0.9, better=0.9, gained=9.0, remains=0.9)},
        sensor=np.array(sensor),
        passes=False,
        size=40.0,
        time_scale=1.0,
    )


def residuals(
    shape=(6,), *, size: float = 1.0, num: int = 8, times=None
) -> results.Residuals:
    rng = np.random.default_rng(1)
    z = size * rng.normal(size=(num, *shape))
    return results.Residuals(
        action=np.array(SHUFFLED[:num])[:, None],
        index=np.arange(num, dtype=float),
        times=times,
        x=z + 2,
        mean=np.full_like(z, 2.0),
        sd=np.ones_like(z),
        refitted=z,
        correlation=0.8 if times is not None else 0.0,
        noise="declared",
    )


def evaluation(num: int = 8) -> results.Evaluation:
    rng = np.random.default_rng(2)
    before = {
        "rmse": 0.05 + 0.02 * rng.random(num),
        "energy score": 0.03 + 0.01 * rng.random(num),
        "log predictive density": -20 - 5 * rng.random(num),
        "coverage": np.round(rng.random(num) * 6) / 6,
    }
    after = {
        "rmse": 0.2 * before["rmse"],
        "energy score": 0.25 * before["energy score"],
        "log predictive density": before["log predictive density"] + 35,
        "coverage": np.full(num, 0.8),
    }
    table = pd.DataFrame({"metric": [*before], "ratio": [0.2, 0.25, 35.0, 0.3]})
    for name, scores in (("before", before), ("after", after)):
        table[name] = [own.mean() for own in scores.values()]
    table = table.assign(low=0.9 * table["ratio"], high=1.1 * table["ratio"])
    return results.Evaluation(
        scheme="held out",
        trials=np.arange(num, dtype=float),
        before=before,
        after=after,
        table=table,
    )


def trials(action=SHUFFLED[:8]) -> Trials:
    return Trials(torch.tensor(action), torch.randn(len(action), 6))


def report(**changes):
    noise = GaussianNoise(0.005)
    parts = {
        "trials": trials(),
        "residuals": residuals(size=6.0),
        "residuals_after": residuals(),
        "detection": results.Detection(
            log_bayes_factor=8.2,
            threshold=float(np.log(20)),
            chi_square=180.4,
            degrees_of_freedom=46,
            p_value=1e-16,
            level=0.01,
            null_log_evidence=-3.0,
        ),
        "tracing": tracing(),
        "evaluation": evaluation(),
        "next_action": results.NextAction(
            action=np.array([3.0]),
            candidates=np.array([[1.0], [3.0]]),
            information_gain=np.array([0.1, 0.41]),
            separates=("drag", "tilt"),
        ),
        "simulator": SimulatorModel(
            lambda theta, action: theta[:, :1] * torch.ones(1, 6), noise=noise
        ),
        "prior": BoxUniform(torch.zeros(3), torch.ones(3)),
        "actions": DiscreteActions([1.0, 3.0], names=["speed"], units=["m/s"]),
        "digest": "0123456789abcdef",
    }
    return build_report(**(parts | changes))
