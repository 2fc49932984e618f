"""Bayesian optimization by BoTorch."""

from __future__ import annotations

import warnings
from itertools import product

import torch
from torch import Tensor

from sbi_active.search.base import Evaluations
from sbi_active.search.cube import Coordinates
from sbi_active.search.sequential import (
    Progress,
    SequentialSearch,
    permitted_points,
    spaced,
)
from sbi_active.seeding import derive_seed, forked_generators

#: Choices: what one proposal costs. As in the gradient search, 64 points to start from
#: and 50 steps.
NUM_RESTARTS, RAW_SAMPLES, DRAWS, MAX_STEPS = 4, 64, 64, 50
MOST_COMBINATIONS = 24  # of categories, each of which is optimized by itself
APART_AT_LAST = 0.02  # in the unit cube, as in the gradient search


class BayesianOptimization(SequentialSearch):
    r"""Noisy expected improvement on a Gaussian process, by BoTorch.

    Batches maximize qLogNoisyExpectedImprovement one action after the other. The
    finalists are the best of the posterior mean among points that fill the space and
    the actions evaluated. Install it with ``pip install sbi-active[botorch]``. Actions
    with too improbable a measurement are evaluated all the same, and not chosen.

    Args:
        num_rounds: Rounds after the first.
        num_finalists: Actions to compare in the end.

    Raises:
        ImportError: If BoTorch is not installed.

    References:
        Balandat et al., NeurIPS 2020 (BoTorch); Ament et al., NeurIPS 2023 (log
        expected improvement).
    """

    def __init__(self, *, num_rounds: int = 4, num_finalists: int = 5) -> None:
        super().__init__(num_rounds=num_rounds, num_finalists=num_finalists)
        try:
            import botorch  # noqa: F401
        except ImportError as error:
            raise ImportError(
                "expected BoTorch for search='bayesopt'; got none; run "
                "pip install sbi-active[botorch], or use search='gradient'"
            ) from error

    def _propose(self, progress: Progress, num: int, index: int) -> Tensor:
        from botorch.acquisition.logei import qLogNoisyExpectedImprovement
        from botorch.optim import optimize_acqf_mixed
        from botorch.sampling.normal import SobolQMCNormalSampler

        objective, coordinates, found = progress
        seed = derive_seed(objective.seed, "bayesopt", index)
        model = _model(coordinates, found)
        sampler = SobolQMCNormalSampler(torch.Size([DRAWS]), seed=seed % 2**31)
        known = coordinates.points(found.action)
        acquisition = qLogNoisyExpectedImprovement(
            model, known, sampler=sampler, prune_baseline=True
        )
        upper = [1.0] * coordinates.num_continuous
        upper += [float(size - 1) for size in coordinates.sizes]
        bounds = torch.tensor([[0.0] * coordinates.dim, upper], dtype=torch.float64)
        with warnings.catch_warnings(), forked_generators(seed), torch.enable_grad():
            warnings.simplefilter("ignore")  # a restart that fails is tried again
            point, _ = optimize_acqf_mixed(
                acquisition,
                bounds,
                q=num,
                num_restarts=NUM_RESTARTS,
                raw_samples=RAW_SAMPLES,
                options={"maxiter": MAX_STEPS},
                fixed_features_list=self._fixed(coordinates, known),
            )
        action = coordinates.actions(point.detach())
        return action[objective.permitted(action)]

    def _best(self, progress: Progress, num: int) -> Tensor:
        objective, coordinates, found = progress
        point = torch.cat(
            [
                permitted_points(objective, coordinates, 2_048, "finalists"),
                coordinates.points(found.action)[objective.permitted(found.action)],
            ]
        )
        model = _model(coordinates, found)
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mean = model.posterior(point).mean[:, 0]
        c = coordinates.num_continuous
        best = spaced(point, mean, num, num_continuous=c, apart=APART_AT_LAST)
        return coordinates.actions(point[best])

    def _fixed(self, coordinates: Coordinates, known: Tensor) -> list[dict[int, float]]:
        """Return combinations of categories; of many, those evaluated."""
        c = coordinates.num_continuous
        every = [*product(*map(range, coordinates.sizes))]
        if len(every) > MOST_COMBINATIONS:
            every = [tuple(row) for row in known[:, c:].unique(dim=0).tolist()]
        return [{c + j: float(k) for j, k in enumerate(row)} for row in every]


def _model(coordinates: Coordinates, found: Evaluations):  # noqa: ANN202
    """Return a fitted Gaussian process on points."""
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import MixedSingleTaskGP, SingleTaskGP
    from botorch.models.transforms import Standardize
    from gpytorch.mlls import ExactMarginalLogLikelihood

    point = coordinates.points(found.action)
    value = found.utility.double()[:, None]
    variance = found.standard_error.double().square()[:, None].clamp_min(1e-8)
    options = {"train_Yvar": variance, "outcome_transform": Standardize(m=1)}
    if coordinates.sizes:
        categories = [*range(coordinates.num_continuous, coordinates.dim)]
        model = MixedSingleTaskGP(point, value, cat_dims=categories, **options)
    else:
        model = SingleTaskGP(point, value, **options)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    return model
