"""Arguments of sbi's ``train``, and what they mean in a round with actions."""

from __future__ import annotations

import inspect
from typing import Any

from sbi.inference import NPE_C

from sbi_active.inference.networks.mixture_density import MixtureDensity

__all__ = ["NPE_DEFAULTS", "action_arguments", "given_arguments"]

NPE_DEFAULTS = {
    name: parameter.default
    for name, parameter in inspect.signature(NPE_C.train).parameters.items()
    if parameter.default is not inspect.Parameter.empty
}
_NONE_IS_THE_DEFAULT = (
    *("num_atoms", "training_batch_size", "learning_rate", "validation_fraction"),
    *("stop_after_epochs", "max_num_epochs"),
)
_NO_MEANING_WITH_ACTION = ("discard_prior_samples", "use_combined_loss", "num_atoms")


def given_arguments(values: dict[str, Any]) -> dict[str, Any]:
    """Return those of a call's values that are arguments of sbi's and were given."""
    return {
        name: value
        for name, value in values.items()
        if name in NPE_DEFAULTS and not (value is None and name in _NONE_IS_THE_DEFAULT)
    }


def action_arguments(
    given: dict[str, Any], settings: MixtureDensity | None
) -> dict[str, Any]:
    """Return the arguments of a round with actions, for the parent of ``NPE_C``.

    Args:
        given: By the caller.
        settings: Their defaults; None is sbi's.

    Raises:
        ValueError: If an argument has no meaning in a round with actions.
    """
    arguments = {**NPE_DEFAULTS, **given}
    for name in _NO_MEANING_WITH_ACTION:
        if arguments[name] != NPE_DEFAULTS[name]:
            raise ValueError(
                f"expected {name} to be left out in a round with actions, which is "
                f"trained by maximum likelihood; got {arguments[name]}; do drop it"
            )
    if settings is not None:
        defaults = {
            "training_batch_size": settings.batch_size,
            "learning_rate": settings.learning_rate,
        }
        arguments = {**arguments, **defaults, **given}
    for name in ("num_atoms", "use_combined_loss"):
        del arguments[name]
    arguments["force_first_round_loss"] = True
    arguments["retrain_from_scratch"] = not arguments["resume_training"]
    return arguments
