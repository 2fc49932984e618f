"""The choice of an outcome's summary as a part of the action."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions.discrete import DiscreteActions
from sbi_active.actions.space import ActionSpace
from sbi_active.expected import require


class SummaryAction(DiscreteActions):
    r"""A choice :math:`\delta \in \{1, \ldots, K\}` among summaries of one outcome.

    It is joined with what the robot does, ``MixedActions(BoxActions(...),
    SummaryAction(...))``. The simulator returns the raw outcome, shape (n, k), whatever
    :math:`\delta` is; a campaign calls it with :math:`\delta` = 0, once for all
    summaries, so that the choice costs nothing and gains are compared on the same
    simulations. Outcomes are told, recorded and stored raw: a later round may summarize
    them otherwise.

    Args:
        summaries: Summaries by name. Each is a function of raw outcomes (n, k), a torch
            tensor, that returns (n, d); or an object with ``fit`` and ``transform`` of
            NumPy arrays, such as ``sklearn.decomposition.PCA``, of which copies are
            fitted to the simulations of a round.
        use: Summary that a belief rests on: at each trial the "best", which is expected
            to be most informative at the executed action, since all of them are at
            hand; or the "chosen" one, as in Kim & Matsubara (2025).
        name: Name of the entry.

    Attributes:
        summaries: Summaries by name, as given.
        labels: Names of the summaries, in the order of :math:`\delta`.
        use: Summary that a belief rests on, "best" or "chosen".

    Raises:
        ValueError: If there is no summary, or ``use`` is another word.
        TypeError: If one is neither a function nor has ``fit`` and ``transform``.

    Example:
        >>> from sbi_active import BoxActions, MixedActions
        >>> choice = SummaryAction({"total": lambda x: x.sum(1, keepdim=True),
        ...                         "ends": lambda x: x[:, [0, -1]]})
        >>> choice
        SummaryAction(total | ends)
        >>> actions = MixedActions(BoxActions(0.5, 2.0, names=["speed"]), choice)
        >>> actions.names
        ['speed', 'summary']
        >>> choice.label(torch.tensor([1.0]))
        'ends'
    """

    def __init__(
        self,
        summaries: Mapping[str, Any],
        *,
        use: Literal["best", "chosen"] = "best",
        name: str = "summary",
    ) -> None:
        if not isinstance(summaries, Mapping) or not summaries:
            raise ValueError(
                f"expected one or more summaries by name; got {summaries!r:.80}; pass "
                "a dict such as {'mean': lambda x: x.mean(1, keepdim=True)}"
            )
        for label, summary in summaries.items():
            if not (callable(summary) or is_fitted(summary)):
                raise TypeError(
                    f"expected the summary {label!r} to be a function, or an object "
                    f"with fit and transform; got {type(summary).__name__}; pass one"
                )
        is_known, expected = use in ("best", "chosen"), "use 'best' or 'chosen'"
        require(is_known, expected, repr(use), "pass one of these")
        self.summaries, self.use = {**summaries}, use
        self.labels = [*map(str, summaries)]
        super().__init__(torch.arange(len(summaries)), names=[name])

    def __repr__(self) -> str:
        return f"SummaryAction({' | '.join(self.labels)})"

    def label(self, value: Tensor | float) -> str:
        r"""Return the name of the summary of a :math:`\delta`.

        Raises:
            ValueError: If there is none.
        """
        number = float(torch.as_tensor(value).reshape(()))
        if number not in range(len(self.labels)):
            raise ValueError(
                f"expected a summary between 0 and {len(self.labels) - 1}; got "
                f"{number:g}; pass the number of one of {', '.join(self.labels)}"
            )
        return self.labels[int(number)]

    @override
    def contains(self, action: Tensor) -> Tensor:
        action = torch.as_tensor(action, dtype=torch.float32)
        return (action[..., None, :] == self.values).all(-1).any(-1)


def is_fitted(summary: Any) -> bool:
    """Return whether a summary is an object that is fitted to outcomes first."""
    return all(callable(getattr(summary, name, None)) for name in ("fit", "transform"))


def find_summaries(actions: ActionSpace) -> tuple[SummaryAction, int] | None:
    """Return the part of a space that chooses a summary, and its entry of an action.

    Raises:
        ValueError: If several do.
    """
    every = actions.entries()
    found = [(p, own.start) for p, own in every if isinstance(p, SummaryAction)]
    got = f"{len(found)} in {actions!r}"
    require(len(found) <= 1, "one SummaryAction", got, "pass all summaries to one")
    return found[0] if found else None
