"""Priors, actions and options as release 0.1 wrote them in JSON."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import sbi.utils
import torch
from sbi.utils.user_input_checks_utils import MultipleIndependent
from torch import distributions as td

from sbi_active.actions import ActionSpace, BoxActions, DiscreteActions, MixedActions
from sbi_active.campaign import options
from sbi_active.campaign.options import CampaignDetails, CampaignOptions, StopRules
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.models.lfire import LFIRE
from sbi_active.inference.networks import mixture_density
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.ratio_network import RatioClassifier
from sbi_active.renamed import grouped
from sbi_active.simulation.workers.settings import Workers

#: Families that are made by the names of their numbers.
_FAMILIES = {
    kind.__name__: kind
    for kind in (
        *(sbi.utils.BoxUniform, td.MultivariateNormal, td.Uniform, td.Normal),
        *(td.LogNormal, td.HalfNormal, td.StudentT, td.Laplace, td.Cauchy, td.Gamma),
        *(td.Beta, td.Exponential),
    )
}
#: Settings whose fields stood elsewhere in that release.
_GROUPS: dict[Any, Any] = {
    CampaignOptions: options.GROUPS,
    MixtureDensity: mixture_density.GROUPS,
}
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


def prior_from(described: Mapping[str, Any]) -> td.Distribution:
    """Return a prior from its family and numbers."""
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
    return _FAMILIES[family](**values)


def actions_from(described: Mapping[str, Any]) -> ActionSpace:
    """Return an action space from its limits or values."""
    if described["kind"] == "product":
        return MixedActions(*[actions_from(part) for part in described["of"]])
    labels = {"names": described["names"], "units": described["units"]}
    if described["kind"] == "box":
        return BoxActions(described["low"], described["high"], **labels)
    return DiscreteActions(described["values"], **labels)


def options_from(described: Any) -> Any:
    """Return settings; those that no longer exist are left out."""
    if isinstance(described, list):
        return tuple(options_from(item) for item in described)
    if not isinstance(described, dict):
        return described
    if "number" in described:
        return float(described["number"])
    kind = _SETTINGS[described["settings"]]
    known = inspect.signature(kind).parameters
    values = {name: options_from(value) for name, value in described.items()}
    values = grouped(values, _GROUPS.get(kind, {}))
    return kind(**{name: value for name, value in values.items() if name in known})
