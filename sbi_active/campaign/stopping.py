"""When a campaign has learned enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.distributions import Distribution

from sbi_active.design.design import Design
from sbi_active.expected import require
from sbi_active.seeding import derive_seed, forked_generators

NUM_DRAWS = 2_000  # of the belief; 1.6 % error of a standard deviation


@dataclass(frozen=True, kw_only=True)
class StopRules:
    """Rules by which :meth:`.Campaign.run` ends before its last round.

    Any one ends it, but the first two only while the campaign's health is "ok": with a
    simulator that lacks something, a belief becomes narrow at a wrong place, and both
    would stop.

    Attributes:
        min_information_gain: Smallest expected information gain of the next trial,
            nats.
        max_sd: Largest standard deviation of any parameter under the belief: one
            number, or one a parameter, in the parameters' units.
        calibration_lost: Whether to stop if the verdict of
            :mod:`sbi_active.diagnostics` is "stop": the refined belief excludes what
            two new inferences contain; or, if beliefs are the network's posterior, the
            network excludes the truth too often at some action. This ends a campaign
            whatever its health, at the cost of two inferences, or of 1,000 simulations,
            a trial.

    Example:
        >>> StopRules(min_information_gain=0.1, max_sd=[0.05, 0.2])
        StopRules(min_information_gain=0.1, max_sd=(0.05, 0.2), calibration_lost=False)
    """

    min_information_gain: float | None = None
    max_sd: float | Sequence[float] | None = None
    calibration_lost: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.max_sd, Sequence):
            object.__setattr__(self, "max_sd", (*map(float, self.max_sd),))
        limits = [self.min_information_gain, *self._limits()]
        require(
            all(limit is None or limit > 0 for limit in limits),
            "positive limits to stop at",
            self,
            "leave a rule at None that is not wanted",
        )

    def reason(
        self, belief: Distribution, design: Design | None, *, seed: int
    ) -> str | None:
        """Return why to stop, or None.

        Args:
            belief: Belief after all trials.
            design: Design of the next trial, if there is one.
            seed: Seed of the belief's draws.

        Raises:
            ValueError: If ``max_sd`` has neither one number nor one a parameter.
        """
        if design is not None and self.min_information_gain is not None:
            gain = float(design.expected_information_gain[design.index])
            if gain < self.min_information_gain:
                return (
                    f"the next trial is expected to tell {gain:.3g} nats, less than "
                    f"{self.min_information_gain:g}"
                )
        if self.max_sd is None:
            return None
        with forked_generators(derive_seed(seed, "stop")):
            sd = belief.sample(torch.Size([NUM_DRAWS])).double().std(0)
        limits = torch.tensor(self._limits(), dtype=torch.float64)
        if len(limits) not in (1, len(sd)):
            raise ValueError(
                f"expected one max_sd or one for each of {len(sd)} parameters; got "
                f"{len(limits)}; give max_sd in the order of the parameters, those "
                "of adopted effects last"
            )
        if not bool((sd < limits).all()):
            return None
        widths = ", ".join(f"{v:.3g}" for v in sd.tolist())
        return f"the parameters' standard deviations are {widths}, below max_sd"

    def _limits(self) -> Sequence[float]:
        if self.max_sd is None:
            return ()
        return self.max_sd if isinstance(self.max_sd, Sequence) else (self.max_sd,)
