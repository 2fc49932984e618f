"""Priors, actions and options as JSON that a person can read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import sbi.utils
import torch
from sbi.utils.user_input_checks_utils import MultipleIndependent
from torch import Tensor
from torch import distributions as td

from sbi_active.actions import ActionSpace, BoxActions, DiscreteActions, MixedActions
from sbi_active.campaign.options import (
    GROUPS,
    CampaignDetails,
    CampaignOptions,
    StopRules,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.models.lfire import LFIRE
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.ratio_network import RatioClassifier
from sbi_active.renamed import grouped
from sbi_active.simulation.workers.settings import Workers

#: Arguments by which each is made anew.
_PRIORS: dict[type, tuple[str, ...]] = {
    td.Uniform: ("low", "high"),
    td.Normal: ("loc", "scale"),
    td.LogNormal: ("loc", "scale"),
    td.HalfNormal: ("scale",),
    td.StudentT: ("df", "loc", "scale"),
    td.Laplace: ("loc", "scale"),
    td.Cauchy: ("loc", "scale"),
    td.Gamma: ("concentration", "rate"),
    td.Beta: ("concentration1", "concentration0"),
    td.Exponential: ("rate",),
}
_BY_NAME = {kind.__name__: kind for kind in _PRIORS}
_SETTINGS = {
    kind.__name__: kind
    for kind in (
        CampaignDetails,
        CampaignOptions,
        LFIRE,
        MixtureDensity,
        RatioClassifier,
        RefinementOptions,
        StopRules,
        Workers,
    )
}


def describe_prior(prior: td.Distribution) -> dict[str, Any] | None:
    """Return a prior as JSON; None for one that only its author can make again."""
    if type(prior) is sbi.utils.BoxUniform:
        base: Any = prior.base_dist
        return {"family": "BoxUniform", **_numbers(low=base.low, high=base.high)}
    if type(prior) is td.MultivariateNormal:
        factor = prior._unbroadcasted_scale_tril
        numbers = _numbers(loc=prior.loc, scale_tril=factor)
        return {"family": "MultivariateNormal", **numbers}
    if type(prior) is td.Independent:
        inner = describe_prior(prior.base_dist)
        ndims = prior.reinterpreted_batch_ndims
        return inner and {"family": "Independent", "base": inner, "ndims": ndims}
    if type(prior) is MultipleIndependent:
        parts = [describe_prior(part) for part in prior.dists]
        return None if None in parts else {"family": "MultipleIndependent", "of": parts}
    names = _PRIORS.get(type(prior))
    if names is None:
        return None
    values = {name: getattr(prior, name) for name in names}
    return {"family": type(prior).__name__, **_numbers(**values)}


def prior_from(described: Mapping[str, Any]) -> td.Distribution:
    """Return the prior of :func:`describe_prior`."""
    family = described["family"]
    if family == "Independent":
        return td.Independent(prior_from(described["base"]), described["ndims"])
    if family == "MultipleIndependent":
        return MultipleIndependent([prior_from(part) for part in described["of"]])
    dtype = getattr(torch, described["dtype"])
    values: dict[str, Any] = {
        name: torch.tensor(value, dtype=dtype)
        for name, value in described.items()
        if name not in ("family", "dtype")
    }
    if family == "BoxUniform":
        return sbi.utils.BoxUniform(**values)
    if family == "MultivariateNormal":
        return td.MultivariateNormal(**values)
    return _BY_NAME[family](**values)


def describe_actions(actions: ActionSpace) -> dict[str, Any] | None:
    """Return an action space as JSON; None for one that only its author can make."""
    labels = {"names": [*actions.names], "units": [*actions.units]}
    if type(actions) is BoxActions:
        limits = {"low": actions.low.tolist(), "high": actions.high.tolist()}
        return {"kind": "box", **limits, **labels}
    if type(actions) is DiscreteActions:
        return {"kind": "list", "values": actions.values.tolist(), **labels}
    if type(actions) is MixedActions:
        parts = [describe_actions(part) for part in actions.parts()]
        return None if None in parts else {"kind": "product", "of": parts}
    return None


def actions_from(described: Mapping[str, Any]) -> ActionSpace:
    """Return the action space of :func:`describe_actions`."""
    if described["kind"] == "product":
        return MixedActions(*[actions_from(part) for part in described["of"]])
    labels = {"names": described["names"], "units": described["units"]}
    if described["kind"] == "box":
        return BoxActions(described["low"], described["high"], **labels)
    return DiscreteActions(described["values"], **labels)


def describe_options(options: Any) -> Any:
    """Return settings as JSON, those that are not the default; None if not possible."""
    try:
        return _plain(options)
    except TypeError:
        return None


def options_from(described: Any) -> Any:
    """Return the settings of :func:`describe_options`.

    Settings of an earlier version that no longer exist are left out.
    """
    if isinstance(described, list):
        return tuple(options_from(item) for item in described)
    if not isinstance(described, dict):
        return described
    if "number" in described:
        return float(described["number"])
    kind = _SETTINGS[described["settings"]]
    known = {f.name for f in dataclasses.fields(kind)}
    values = {name: options_from(value) for name, value in described.items()}
    if kind is CampaignOptions:
        values = grouped(values, GROUPS)
    return kind(**{name: value for name, value in values.items() if name in known})


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        is_plain = value == value and abs(value) != float("inf")
        return value if is_plain else {"number": str(value)}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if _SETTINGS.get(type(value).__name__) is not type(value):
        raise TypeError(f"{type(value).__name__} is up to its author")
    defaults = {f.name: _default(f) for f in dataclasses.fields(value) if f.init}
    chosen = {n: getattr(value, n) for n, d in defaults.items()}
    return {
        "settings": type(value).__name__,
        **{n: _plain(v) for n, v in chosen.items() if v != defaults[n]},
    }


def _default(entry: dataclasses.Field[Any]) -> Any:
    factory: Callable[[], Any] | Any = entry.default_factory
    return entry.default if factory is dataclasses.MISSING else factory()


def _numbers(**values: Tensor) -> dict[str, Any]:
    dtype = next(iter(values.values())).dtype
    numbers = {name: value.detach().cpu().tolist() for name, value in values.items()}
    return {**numbers, "dtype": str(dtype).removeprefix("torch.")}
