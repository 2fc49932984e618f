"""Arguments of sbi's methods, and what they mean in a round with actions."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
Ours = TypeVar("Ours", bound=Callable[..., Any])

#: Number of epochs that sbi's own default allows.
NEVER = 2**31 - 1
#: Arguments of NPE_C, which choose between losses of several rounds.
_NO_MEANING_WITH_ACTION = ("discard_prior_samples", "use_combined_loss", "num_atoms")


def takes(theirs: Callable[P, R]) -> Callable[[Callable[..., Any]], Callable[P, R]]:
    """Give a method of ours the signature of sbi's, which is then written once."""

    def decorate(ours: Callable[..., Any]) -> Callable[P, R]:
        ours.__signature__ = inspect.signature(theirs)  # pyright: ignore
        return ours

    return decorate


def extends(theirs: Callable[..., Any]) -> Callable[[Ours], Ours]:
    """Give a method the signature of sbi's, with keywords of its own after that."""

    def decorate(ours: Ours) -> Ours:
        further = inspect.signature(ours).parameters.values()
        own = [p for p in further if p.kind is inspect.Parameter.KEYWORD_ONLY]
        known = inspect.signature(theirs).parameters.values()
        ours.__signature__ = inspect.Signature([*known, *own])  # pyright: ignore
        return ours

    return decorate


def given_arguments(
    method: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> dict[str, Any]:
    """Return by name the arguments that a call of a method of sbi's was given.

    None stands for sbi's default, but as ``clip_max_norm``, where it says not to clip.
    """
    given = inspect.signature(method).bind(*args, **kwargs).arguments
    return {
        name: value
        for name, value in given.items()
        if value is not None or name == "clip_max_norm"
    }


def require_likelihood_loss(
    method: Callable[..., Any], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return arguments without those of the losses of several rounds.

    Raises:
        ValueError: If one of these was given another value than its default.
    """
    parameters = inspect.signature(method).parameters
    for name in _NO_MEANING_WITH_ACTION:
        default = parameters[name].default
        if given.get(name, default) != default:
            raise ValueError(
                f"expected {name} to be left out in a round with actions, which is "
                f"trained by maximum likelihood; got {given[name]}; drop it"
            )
    return {n: v for n, v in given.items() if n not in _NO_MEANING_WITH_ACTION}
