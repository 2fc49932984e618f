"""Parameters that depend on what a trial shows, as effects that nobody declares."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution, Normal

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel
from sbi_active.support import support_bounds, support_of


@dataclass(frozen=True)
class _Varied:
    """Shifts a parameter by phi where a variable is at the end of its range.

    Attributes:
        parameter: Place of the parameter in theta.
        sd: Its prior deviation.
        entry: Entry of the action that it depends on; None for the order of the trials.
        center: Middle of the range of that variable.
        half: Half of this range.
        bounds: Ends of the prior, beyond which the simulator may not be defined.
    """

    parameter: int
    sd: float
    entry: int | None
    center: float
    half: float
    bounds: tuple[float, float]

    def __call__(
        self, theta: Tensor, phi: Tensor, action: Tensor, context: Context
    ) -> Tensor:
        value = context.index if self.entry is None else action[:, self.entry]
        place = (value.to(theta) - self.center) / self.half
        column = theta[:, self.parameter]
        moved = (column + phi[:, 0] * self.sd * place).clamp(*self.bounds)
        # What lies beyond already, as another effect may make it, is left there.
        theta[:, self.parameter] = torch.where(phi[:, 0] == 0, column, moved)
        return theta


def varying_parameters(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    scale: float = 0.5,
) -> list[Effect]:
    r"""Return effects that make each parameter depend on what the trials show.

    .. math::
        \theta_j \to \theta_j + \phi\, s_j\, z(v), \qquad z \in [-1, 1],

    with the prior deviation :math:`s_j` of the parameter and, in units of the range of
    the trials, an entry of the action or the place v of the trial in their order. A
    friction that grows with speed or a motor that warms up is of this kind. The
    parameter stays within the bounds of its prior. All effects of one parameter are one
    family, which shares a prior probability.

    Args:
        model: The simulator; its ``parameter_names`` name the effects.
        prior: Prior of its parameters.
        trials: Measured trials. Entries of the action that do not differ, and actions
            that are labels, vary nothing; nor does an order that is unknown.
        scale: Prior standard deviation of phi: the change of a parameter, in its own
            prior deviations, from the middle to an end of the range. A third
            and three times are tried as well, so that half or twice says little else.

    Returns:
        Effects for ``close_loop(effects=...)``, up to (action_dim + 1) a parameter.

    Example:
        >>> import torch
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import SimulatorModel
        >>> from sbi_active.criticism import Trials, varying_parameters
        >>> model = SimulatorModel(lambda theta, v: theta * v, parameter_names=["grip"])
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> trials = Trials(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.9]))
        >>> [effect.name for effect in varying_parameters(model, prior, trials)]
        ['grip by action', 'grip by trial']
    """
    low, high = support_bounds(support_of(prior), prior.event_shape[0])
    with forked_generators(0, "deviations"):
        sd = prior.sample(torch.Size([256])).double().std(0)  # to some 5 %
    names = model.parameter_names or [f"theta_{j + 1}" for j in range(len(sd))]
    effects = []
    for j, name in enumerate(names):
        for label, unit, entry, center, half in _variables(trials):
            varied = _Varied(
                *(j, float(sd[j]), entry, center, half),
                bounds=(float(low[j]), float(high[j])),
            )
            effects.append(
                Effect(
                    f"{name} by {label}",
                    hook="parameter",
                    prior=Normal(0.0, scale),
                    null=0.0,
                    apply=varied,
                    units="prior sd",
                    family=f"varying {name}",
                    describe=f"{name} changes with {label}{unit}, by phi prior "
                    "deviations from the middle of the range tried to its end",
                    needs_order=entry is None,
                )
            )
    return effects


def _variables(trials: Trials) -> Iterator[tuple[str, str, int | None, float, float]]:
    """Yield name, unit, entry of the action, middle and half range of each variable."""
    columns = [] if trials.action_is_label else [*trials.action.double().T]
    plain = [f"action {k + 1}" for k in range(len(columns))]
    labels = trials.action_labels or (["action"] if len(columns) == 1 else plain)
    given: list[tuple[str, int | None, Tensor]] = [
        *zip(labels, range(len(columns)), columns, strict=False)
    ]
    if trials.order != "unknown":
        given.append(("trial", None, trials.index.double()))
    for label, entry, column in given:
        low, high = float(column.min()), float(column.max())
        if high > low:
            name, _, unit = label.partition(" [")
            unit = f" ({unit.removesuffix(']')})" if unit else ""
            yield name, unit, entry, (low + high) / 2, (high - low) / 2
