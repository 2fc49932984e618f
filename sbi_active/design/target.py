"""What a design is about: some parameters, or a quantity that depends on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.automatic import find_estimator
from sbi_active.design.estimators.base import InformationGainEstimator
from sbi_active.design.estimators.linear import LinearGain
from sbi_active.design.estimators.posterior import ParameterGain
from sbi_active.design.limits import takes_second
from sbi_active.expected import require
from sbi_active.seeding import draws_of, forked_generators
from sbi_active.simulation import Simulations

#: "theta", "model", names of parameters, or a function of parameters (n, theta_dim).
Target = str | Sequence[str] | Callable[..., Tensor]


def name_of(target: Target) -> str:
    """Return the target in a word or a list of names."""
    if callable(target):
        return getattr(target, "__name__", type(target).__name__)
    return target if isinstance(target, str) else ", ".join(target)


def target_estimator(
    target: Target,
    given: str | InformationGainEstimator,
    model: Any,
    simulator: Any,
    belief: Distribution | None,
    simulations: Simulations | None,
    num_others: int,
) -> InformationGainEstimator | None:
    """Return the estimator; None where simulations or rivals are to decide.

    Args:
        target: Target of the design.
        given: Estimator as the designer was given it, or its name.
        model: Model that it may need.
        simulator: Simulator of the parameters.
        belief: Distribution of the parameters.
        simulations: Rows at hand; None simulates.
        num_others: Number of actions whose outcomes will be known as well.

    Raises:
        ValueError: If what the target or the estimator needs is lacking.
    """
    kind = type(model).__name__
    if target == "model":
        fits = isinstance(model, Sequence) and simulations is None
        require(
            given == "auto" and fits and not num_others,
            "estimator='auto', a sequence of rivals, no simulations= and one action at "
            "a time for target='model'",
            f"{given!r}, {kind} and {num_others} others",
            "pass objects with probability and predict(action, num_samples, seed)",
        )
        return None
    if belief is None or (simulator is None and simulations is None):
        raise ValueError(
            "expected a simulator and belief=, the distribution of its parameters; got "
            f"no {'belief' if belief is None else 'simulator'}; pass both"
        )
    require(
        simulations is None or model is not None and not num_others,
        "a model, one action and none pending with simulations=, of single outcomes",
        *(f"{kind} and {num_others} others", "pass the trained model, or leave it out"),
    )
    if target == "theta":
        estimator = find_estimator(given)
        lacks = model is None or num_others and not hasattr(model, "log_likelihood")
        require(
            estimator is None or not (estimator.needs_model and lacks),
            f"a model for {type(estimator).__name__}, with log_likelihood if several "
            "actions are to tell together",
            *(kind, "pass the trained posterior, or estimator='auto'"),
        )
        return estimator
    known = f"estimator='auto' or 'linear' for target={name_of(target)!r}"
    require(given in ("auto", "linear"), known, repr(given), "leave out estimator=")
    if callable(target):
        quantity = Quantity(target, simulator, belief)
        num = quantity.num_draws
    else:
        quantity, num = _named(target, simulator), 20_000
    if given == "linear":
        return LinearGain(quantity)
    return ParameterGain(quantity, num_marginal=num)


def _named(names: str | Sequence[str], simulator: Any) -> Callable[[Tensor], Tensor]:
    """Return a function that gives parameters by name, (n, d) -> (n, k).

    Raises:
        ValueError: If the simulator does not have them.
    """
    known = [*(getattr(simulator, "parameter_names", None) or ())]
    wanted = [names] if isinstance(names, str) else [*names]
    require(
        bool(wanted) and {*wanted} <= {*known} and len({*wanted}) == len(wanted),
        "target 'theta', 'model', a function, or different names among the simulator's "
        f"parameter_names {known}",
        *(repr(names), "choose one or more of these"),
    )
    index = [known.index(name) for name in wanted]
    return lambda theta: theta[:, index]


class Quantity:
    r"""A function :math:`g(\theta)` as few numbers, by which candidates are compared.

    Information about g does not change where g is scaled or shifted. If g has more
    numbers than estimators take, as a motion has, the leading principal components of
    the standardized numbers replace them, which tell at most as much. Values that many
    parameters share, such as a failure or none, get normal noise of a tenth of their
    deviation, since estimators need densities; the information is then a lower bound
    that may be .3 nat low, and .5 with some hundred draws.

    Args:
        function: ``g(theta)``, of parameters (n, theta_dim), or ``g(theta, effect)``,
            of those of the bare simulator and a dict of each effect's, (n, phi_dim), by
            its name. It returns shape (n,) or (n, k).
        simulator: Simulator that the parameters belong to, with its effects if any.
        belief: Distribution of the parameters.
        num_draws: Draws of the belief that scales come from; of 2,000 a deviation is
            known to 2 %.
        most: Numbers beyond which principal components stand for g: densities of more
            than four take more than some hundred simulations.
        num_shared: Number of draws a value, on average, from which values are shared.

    Raises:
        ValueError: If the function returns another shape, values that are no finite
            numbers, or a number that is the same for all parameters.
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        simulator: Any,
        belief: Distribution,
        *,
        num_draws: int = 2_000,
        most: int = 4,
        num_shared: int = 4,
    ) -> None:
        self.function, self.num_draws = function, num_draws
        every = getattr(simulator, "effects", ())
        self._effects = [e for e in every if e.scope == "campaign"]
        self._known: dict[bytes, Tensor] = {}
        theta = draws_of(belief, num_draws, 0, "marginal")
        value = self._value(theta)
        self.center, self.scale = value.mean(0), value.std(0)
        size = value.abs().amax(0)
        constant = torch.nonzero(~(self.scale > 1e-9 * size))[:, 0].tolist()
        got = f"the same for {num_draws} draws of the belief in columns {constant}"
        expected = "values of target= that differ between parameters"
        require(not constant, expected, got, "return what depends on the parameters")
        num_values = torch.tensor([len(column.unique()) for column in value.T])
        self.jitter = 0.1 * (num_values * num_shared < num_draws).double()
        self.direction = torch.eye(value.shape[1], dtype=torch.float64)
        if value.shape[1] > most:
            z = (value - self.center) / self.scale
            self.direction = torch.linalg.eigh(z.T @ z).eigenvectors.flip(1)[:, :most]
        self._known[theta.numpy().tobytes()] = self._reduced(value)

    def __call__(self, theta: Tensor) -> Tensor:
        """Return the numbers at parameters, shape (n, k), float64."""
        key = theta.numpy().tobytes()  # a search asks again and again
        if key not in self._known:
            self._known[key] = self._reduced(self._value(theta))
        return self._known[key]

    def _reduced(self, value: Tensor) -> Tensor:
        z = (value - self.center) / self.scale
        with forked_generators(0, "jitter"):
            z = z + self.jitter * torch.randn_like(z)
        return z @ self.direction

    def _value(self, theta: Tensor) -> Tensor:
        """Return what the function returns, checked, shape (n, k), float64."""
        given = [theta.clone()]
        if takes_second(self.function):
            sizes = [effect.phi_dim for effect in self._effects]
            base, *phi = theta.clone().split([theta.shape[1] - sum(sizes), *sizes], 1)
            names = [effect.name for effect in self._effects]
            given = [base, dict(zip(names, phi, strict=True))]
        value = torch.as_tensor(self.function(*given)).detach().double()
        value = value[:, None] if value.ndim == 1 else value
        lost = int((~value.isfinite()).sum())
        n = len(theta)
        require(
            value.ndim == 2 and len(value) == n and value.shape[1] > 0 and not lost,
            f"finite values of target= of shape ({n},) or ({n}, k)",
            f"{tuple(value.shape)}, {lost} of them NaN or inf",
            "return a number in each row, such as the largest loss of a failure",
        )
        return value
