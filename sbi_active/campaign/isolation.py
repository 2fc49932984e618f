"""A campaign's methods, apart from the state of the process that calls them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch

from sbi_active.seeding import kept_generators

Method = TypeVar("Method", bound=Callable[..., Any])


def isolated(method: Method) -> Method:
    """Return a method that neither needs nor changes what torch keeps globally.

    It trains under ``torch.no_grad`` and ``torch.inference_mode`` too, and restores the
    global generators: sbi draws from a prior to look at it.
    """

    @functools.wraps(method)
    def apart(*arguments: Any, **options: Any) -> Any:
        with kept_generators(), torch.inference_mode(False), torch.enable_grad():
            return method(*arguments, **options)

    return apart  # type: ignore[return-value]


def guarded(method: Method) -> Method:
    """Return a method of a campaign that one thread at a time runs.

    A trial that is told while another thread designs or learns waits for it: both
    change the same history.
    """

    @functools.wraps(method)
    def alone(campaign: Any, *arguments: Any, **options: Any) -> Any:
        with campaign._guard:
            return method(campaign, *arguments, **options)

    return alone  # type: ignore[return-value]
