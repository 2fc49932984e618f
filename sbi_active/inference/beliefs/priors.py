"""Checks of a prior before a belief begins from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from sbi.utils.torchutils import set_validate_args
from torch.distributions import Distribution, MixtureSameFamily, constraints

from sbi_active.expected import require
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.seeding import forked_generators
from sbi_active.support import parts_of, within_support


def require_support(
    prior: Distribution | None, *, enumerates: bool = False
) -> Distribution:
    """Return the prior, or raise where it has no support to keep a belief in.

    Args:
        prior: Distribution of the parameters.
        enumerates: Whether parameters of a few values are welcome.

    Raises:
        ValueError: If there is no prior, it is a batch of them, its ``support`` is not
            implemented, or its parameters are discrete or tied to one another; if
            torch's defaults are such that no belief can be computed.
    """
    dtype, device = torch.get_default_dtype(), torch.get_default_device()
    require(
        dtype in (torch.float32, torch.float64) and device.type != "meta",
        "torch to make tensors of float32 or float64 that hold numbers",
        f"default dtype {dtype} and device {device}",
        "call torch.set_default_dtype(torch.float32) and "
        "torch.set_default_device('cpu')",
    )
    name = type(prior).__name__
    if prior is None:
        raise ValueError(
            "expected a prior, since a belief starts from it; got None; pass one "
            "at construction, ASBI(prior)"
        )
    try:
        support = prior.support
    except (NotImplementedError, AttributeError):
        support = None
    require(
        support is not None and hasattr(prior, "event_shape"),
        "a prior with a support, which every belief keeps",
        f"{name}",
        "use sbi.utils.BoxUniform, a torch distribution, or sbi.utils.process_prior "
        "with lower_bound and upper_bound",
    )
    may_be = enumerates and Enumeration.of(prior) is not None
    require(
        may_be or not any(map(is_discrete, parts_of(support))),
        "a prior of continuous parameters",
        f"a discrete one, {_shown_prior(prior)}",
        f"put parameters of up to {Enumeration.most_values} combined values beside "
        "continuous ones with sbi's MultipleIndependent and the method asbi or nsbi, "
        "or declare the choice as an Effect",
    )
    tied = tuple(map(type, (constraints.simplex, constraints.corr_cholesky)))
    require(
        not any(isinstance(part, tied) for part in parts_of(support)),
        "a prior whose parameters may vary one by one",
        f"{_shown_prior(prior)}, which ties them to one another",
        "use parameters that are free, such as the logarithms of ratios",
    )
    require(
        len(prior.event_shape) == 1 or bool(prior.batch_shape),
        "a prior over parameter sets, event shape (theta_dim,)",
        f"{_shown_prior(prior)} of event shape {tuple(prior.event_shape)}",
        "pass torch.distributions.Independent(distribution of shape (theta_dim,), 1)",
    )
    if any(isinstance(part, MixtureSameFamily) for part in _nested(prior)):
        # torch asks that a value lies within the bounds of every component, and raises
        # for draws of its own; whether it does so at all depends on what was imported.
        set_validate_args(prior, False)
    if prior.batch_shape:
        with forked_generators(0):
            draws = prior.sample(torch.Size([2]))
        require(
            prior.log_prob(draws).shape == (2,),
            "a prior of one density a parameter set",
            f"a batch of {tuple(prior.batch_shape)} densities, {name}",
            f"pass torch.distributions.Independent({name}(...), 1)",
        )
    return prior


def is_discrete(part: Any) -> bool:
    """Return whether a constraint without parts is one of discrete numbers."""
    one_hot = type(constraints.one_hot)
    return bool(getattr(part, "is_discrete", False)) or isinstance(part, one_hot)


def _nested(prior: Any) -> Iterator[Any]:
    """Yield a distribution and those that it is made of."""
    yield prior
    for value in vars(prior).values():
        for part in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(part, Distribution):
                yield from _nested(part)


def _shown_prior(prior: Distribution) -> str:
    parts = getattr(prior, "dists", None) or [getattr(prior, "base_dist", prior)]
    return ", ".join(type(part).__name__ for part in parts)


def require_width(
    prior: Distribution,
    names: Sequence[str] | None = None,
    *,
    seed: int,
    fewest: int = 64,
) -> None:
    """Raise if a prior is empty, or has no width that float32 can hold.

    Args:
        prior: Prior of the parameters.
        names: Names of the parameters, for the error.
        seed: Seed of some draws.
        fewest: Steps of float32 that a prior's standard deviation is at least; a belief
            is narrower.
    """
    enumeration = Enumeration.of(prior)
    if enumeration is not None:
        if names is not None:
            names = [names[int(k)] for k in enumeration.others]
        require_width(enumeration.rest, names, seed=seed)
        return
    with forked_generators(seed):
        draws = prior.sample(torch.Size([256])).reshape(256, -1).float()
    require(
        bool(within_support(prior, draws).any()),
        "a prior with draws in its support",
        f"{draws[0].tolist()} outside",
        "pass finite bounds, the lower one below the upper one",
    )
    is_named = names is None or len(names) == len({*names}) == draws.shape[1]
    each = f"a different name for each of {draws.shape[1]} parameters"
    require(is_named, each, names, "give one each")
    draws = draws.double()
    size = draws.abs().amax(0).clamp_min(torch.finfo(torch.float32).tiny)
    steps = draws.std(0) / (size * torch.finfo(torch.float32).eps)
    for k, column in enumerate(draws.T):
        name = f"parameter {k}" if names is None else names[k]
        require(
            bool(steps[k] >= fewest),
            "a prior in which parameters vary",
            f"{name} within [{column.min():.9g}, {column.max():.9g}], fewer than "
            f"{fewest} steps of float32 wide",
            "fix the parameter in the simulator, or shift it to deviations from its "
            "value",
        )
        require(
            len(column.unique()) >= len(draws) / 2,
            "a prior of continuous parameters",
            f"{name}, of which draws repeat",
            "fix it in the simulator, or declare a choice as an Effect",
        )
