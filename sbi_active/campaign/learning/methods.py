"""The methods of a campaign by name: what learns, and whether actions are designed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch.distributions import Distribution

from sbi_active.campaign.options import CampaignOptions
from sbi_active.expected import require
from sbi_active.inference import (
    ALHI,
    ASBI,
    LFIRE,
    ActiveInference,
    SeqBED,
    SeqBED_LFIRE,
)


@dataclass(frozen=True)
class Method:
    """A method of active inference.

    Attributes:
        designs: Whether actions are chosen for information, or drawn at random.
        build: Function that makes the trainer of a prior and a campaign's options.
        refines: Whether its beliefs are refined, where the options ask for it.
    """

    designs: bool
    build: Callable[[Distribution, CampaignOptions], ActiveInference]
    refines: bool = False

    def enumerates(self, options: CampaignOptions) -> bool:
        """Return whether parameters may take a few values: refinement alone can."""
        few = options.max_simulations is not None
        return self.refines and options.refine and not few


def _asbi(prior: Distribution, options: CampaignOptions) -> ActiveInference:
    if options.details.posterior != "importance":
        raise ValueError(
            "expected posterior 'importance' for ASBI, whose network is a density and "
            f"needs no sampler; got {options.details.posterior!r}; leave it out"
        )
    return ASBI(prior, options.density_estimator, show_progress_bars=False)


def _sampled(
    prior: Distribution, options: CampaignOptions, kind: Any = ALHI
) -> ActiveInference:
    """Return a trainer whose beliefs are sampled from its network."""
    how = {"show_progress_bars": False, "posterior": options.details.posterior}
    return kind(prior, options.density_estimator, **how)


def _seqbed(prior: Distribution, options: CampaignOptions) -> ActiveInference:
    if isinstance(options.density_estimator, LFIRE):
        return SeqBED_LFIRE(prior, options.density_estimator)
    return _sampled(prior, options, SeqBED)


#: Name of a method: what it is.
METHODS = {
    "asbi": Method(True, _asbi, refines=True),
    "nsbi": Method(False, _asbi, refines=True),
    "alhi": Method(True, _sampled),
    "nlhi": Method(False, _sampled),
    "seqbed": Method(True, _seqbed),
}


def find_method(name: str) -> Method:
    """Return a method by name.

    Raises:
        ValueError: If the name is unknown; it lists the valid ones.
    """
    is_known = isinstance(name, str) and name in METHODS
    expected = f"method to be one of {', '.join(map(repr, METHODS))}"
    require(is_known, expected, repr(name), "choose one of these")
    return METHODS[name]
