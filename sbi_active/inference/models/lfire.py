"""Likelihood-free inference by ratio estimation: a logistic regression a parameter."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegressionCV
from torch import Tensor

from sbi_active.expected import require

FEWEST = 2  # rows of each kind a fold


@dataclass(frozen=True)
class LogRatio:
    r"""The log ratio :math:`\beta^\top \psi(x) + \beta_0` at one parameter set.

    Attributes:
        weight: :math:`\beta`, shape (q,).
        intercept: :math:`\beta_0`.
    """

    weight: NDArray[np.float64]
    intercept: float

    def __call__(self, summary: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return log ratios, shape (n,), of summaries, shape (n, q)."""
        return summary @ self.weight + self.intercept


@dataclass(frozen=True, kw_only=True)
class LFIRE:
    r"""Settings of a penalized logistic regression a parameter set.

    .. math::
        \log \frac{p(x | \theta, \xi)}{p(x | \xi)} \approx
        \beta_\theta^\top \psi(x) + \beta_{\theta, 0}

    separates outcomes at :math:`\theta` from outcomes of the marginal, both kinds
    weighing alike; a ridge penalty is chosen by cross-validated log loss.

    Attributes:
        summary: :math:`\psi`, outcomes (n, *x_shape) to summaries (n, q); None takes
            ``powers`` of each number.
        powers: Exponents.
        num_marginal: Rows of the marginal in one regression, at most.
        num_penalties: Strengths to choose from, 0.1 to 10,000 inverse.
        num_folds: Number of folds of the cross-validation.

    References:
        Thomas, Dutta, Corander, Kaski & Gutmann, Bayesian Analysis 2022, who take a
        lasso penalty; on two or three summaries a ridge differs little and costs a
        tenth.
    """

    summary: Callable[[Tensor], Tensor] | None = None
    powers: tuple[int, ...] = (1, 2)
    num_marginal: int = 500
    num_penalties: int = 4
    num_folds: int = 3

    def __post_init__(self) -> None:
        for name, low in (("num_marginal", 10), ("num_penalties", 1), ("num_folds", 2)):
            value = getattr(self, name)
            require(value >= low, f"{name} >= {low}", value, "raise it")

    def summaries(self, x: Tensor, center: Tensor, scale: Tensor) -> Tensor:
        """Return summaries, and whether there was a measurement, shape (n, q + 1).

        Args:
            x: Outcomes, shape (n, *x_shape); NaN where there was no measurement.
            center: Subtracted from the numbers before powers are taken, (x_dim,).
            scale: Scale by which they are divided, shape (x_dim,).
        """
        flat = x.double().flatten(1)
        valid = flat.isfinite().all(1, keepdim=True)
        if self.summary is not None:
            psi = self.summary(x).double()
        else:
            z = (flat - center) / scale
            psi = torch.cat([z**power for power in self.powers], 1)
        return torch.cat([torch.where(valid, psi, 0.0), valid.double()], 1)

    def fit(
        self, own: NDArray[np.float64], marginal: NDArray[np.float64], seed: int
    ) -> LogRatio:
        """Return the log ratio at one parameter set.

        Args:
            own: Summaries of its outcomes, shape (n, q).
            marginal: Summaries of outcomes of the belief, shape (m, q).
            seed: Seed of the folds.
        """
        fewest = FEWEST * self.num_folds
        if min(len(own), len(marginal)) < fewest:
            raise ValueError(
                f"expected at least {fewest} outcomes of a parameter set and of the "
                f"marginal; got {len(own)} and {len(marginal)}; simulate each "
                "parameter set several times, as SeqBED_LFIRE.arrange() does"
            )
        features = np.concatenate([own, marginal])
        label = np.repeat([1, 0], [len(own), len(marginal)])
        order = np.random.default_rng(seed).permutation(len(label))
        model = LogisticRegressionCV(
            Cs=np.logspace(-1, 4, self.num_penalties),  # pyright: ignore
            cv=self.num_folds,
            scoring="neg_log_loss",
            solver="newton-cholesky",
            class_weight="balanced",
        )
        with warnings.catch_warnings():  # of arguments whose defaults will change
            warnings.simplefilter("ignore")
            model.fit(features[order], label[order])
        return LogRatio(model.coef_[0], float(model.intercept_[0]))
