r"""World A: the numerical model with eight effects.

.. math::
    x = \theta_1 e^{3 - \xi} + \theta_2 \xi + \varepsilon, \quad
    \varepsilon \sim \mathcal N(0, 1), \quad \theta \sim U[-5, 5]^2, \quad
    \xi \in \{-5, -4.5, \ldots, 5\}.

A gain of x is a change of theta, so no action shows it. An offset of the action is a
change of :math:`\theta_1` and a bias.
"""

from __future__ import annotations

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.criticism.worlds.world import (
    World,
    drifted,
    effect,
    noise_inflation,
    normal,
    shifted,
    signed_uniform,
    stretched,
    uniform,
)
from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect

NOISE_SD = 1.0
#: Logarithms of the limits of a sensor that saturates: 10 to 100,000.
LOG_LIMIT = (2.302585, 11.512925)


def response(
    theta: Tensor,
    action: Tensor,
    *,
    quadratic: Tensor | float = 0.0,
    sine: Tensor | float = 0.0,
    step: Tensor | float = 0.0,
    bump: Tensor | float = 0.0,
    power: Tensor | float = 0.0,
) -> Tensor:
    r"""Return the noise-free x with terms that the bare model lacks.

    Args:
        theta: Shape (n, 2).
        action: Shape (n, 1).
        quadratic: Coefficient of :math:`\xi^2`, a number or one a row, as all.
        sine: Of :math:`\sin 2 \xi`.
        step: Of :math:`1_{\xi > 0}`.
        bump: Of :math:`\exp(-\frac12 ((\xi - 2) / 0.8)^2)`.
        power: Of :math:`0.2 |\xi|^{1.5}`.

    Returns:
        Shape (n, 1).
    """
    xi = action[:, 0]
    x = theta[:, 0] * torch.exp(3 - xi) + theta[:, 1] * xi + quadratic * xi**2
    x = x + sine * torch.sin(2 * xi) + step * (xi > 0)
    x = x + bump * torch.exp(-0.5 * ((xi - 2) / 0.8) ** 2)
    return (x + power * 0.2 * xi.abs() ** 1.5)[:, None]


def library() -> list[Effect]:
    """Return the declared effects."""
    return [
        effect("bias", "observation", normal(5.0), shifted),
        effect("gain", "observation", normal(0.2), stretched),
        Effect.keyword("quadratic", prior=normal(1.0)),
        effect("action offset", "action", normal(0.5), shifted),
        effect("action gain", "action", normal(0.1), stretched),
        effect(
            *("saturation", "observation", uniform(*LOG_LIMIT)),
            lambda x, phi, action, context: x.clamp(-phi.exp(), phi.exp()),
            units="log",
            null=torch.inf,
        ),
        effect("drift", "observation", normal(1.0), drifted, units="a trial"),
    ]


def make_world() -> World:
    """Return world A."""
    return World(
        name="A",
        model=SimulatorModel(
            response,
            noise=GaussianNoise(NOISE_SD),
            parameter_names=["theta_1", "theta_2"],
        ),
        prior=BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2)),
        actions=DiscreteActions(torch.arange(-5, 5.5, 0.5)),
        noise_sd=NOISE_SD,
        library=library,
        scatter=noise_inflation(3.0),
        outside=[
            Effect.keyword("sine", prior=signed_uniform(5.0, 12.0)),
            Effect.keyword("step", prior=signed_uniform(5.0, 12.0)),
            Effect.keyword("bump", prior=signed_uniform(5.0, 12.0)),
            Effect.keyword("power", prior=signed_uniform(5.0, 10.0)),
        ],
        equivalences=[
            frozenset({"none", "gain"}),
            frozenset({"bias", "action offset"}),
        ],
        aliases={"power": frozenset({"quadratic"})},
        formulas={
            "bias": frozenset({"1"}),
            "quadratic": frozenset({"xi^2"}),
            "step": frozenset({"step(xi)", "sign(xi)"}),
            "power": frozenset({"|xi|^1.5"}),
        },
    )
