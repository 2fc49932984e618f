"""Surrogate likelihood: a regression of the outcome and a mixture on its residual."""

from __future__ import annotations

import math
import warnings

import torch
from attrs import evolve
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from sklearn.neural_network import MLPClassifier
from torch import Tensor, nn
from typing_extensions import override

from sbi_active.inference.networks.conditioning import Whitening, can_regress, moments
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.inference.networks.mixture_network import log_prob_of_batch
from sbi_active.inference.networks.response import Response, exceeds_chance, log_normal


class LikelihoodNetwork(ConditionalDensityEstimator):
    r"""Density of the outcome given parameters and action.

    .. math::
        q(x | \theta, \xi) = P_\text{valid}(\theta, \xi)\, |W(\xi)|\,
        m\big(W(\xi)\,(x - f(\xi, \theta)) \,\big|\, \theta, \xi\big)

    with f and the noise's whitener W from a :class:`.Response` and m a mixture density
    network on the residual, or the standard normal density where that predicts held-out
    rows as well: the network corrects the regression where that pays. An outcome of NaN
    has the probability :math:`1 - P_\text{valid}`, of a network's logistic output.
    Without a regression, W and f standardize x over all rows.

    Args:
        settings: Settings of the mixture; ``baseline`` is that of the outcome.
        x: Training outcomes, shape (n, x_dim); NaN throughout a row where there was no
            measurement.
        condition: Packed (theta, action), shape (n, theta_dim + action_dim).
        action_dim: Numbers in an action.
        width: Width of the hidden layer of the network of the measurements' share.

    Attributes:
        is_gaussian: Whether the residual's density is the standard normal one.
    """

    def __init__(
        self,
        settings: MixtureDensity,
        x: Tensor,
        condition: Tensor,
        action_dim: int,
        *,
        width: int = 32,
    ) -> None:
        super().__init__(nn.Identity(), x.shape[1:], condition.shape[1:])
        self._theta_dim = condition.shape[1] - action_dim
        theta, action = condition.double().split([self._theta_dim, action_dim], 1)
        valid = x.isfinite().all(-1)
        if int(valid.sum()) < 2:
            raise ValueError(
                f"expected at least two simulations with a measurement; got "
                f"{int(valid.sum())} of {len(x)}; check the simulator, or the belief"
            )
        adapts = settings.details.baseline == "best"
        self.whiten = Whitening(theta, full=adapts)
        self.y_mean, self.y_scale = map(nn.Buffer, moments(x[valid]))
        self.response: Response | None = None
        if adapts and can_regress(valid, x.shape[1]):
            y = (x[valid].double() - self.y_mean) / self.y_scale
            self.response = Response.best(self.whiten(theta[valid]), y, action[valid])
        residual, _ = self._standardize(x[valid].double(), condition[valid])
        seen = self._see(condition)
        # The action's place matters to the regression alone.
        plain = evolve(settings, details=evolve(settings.details, baseline="none"))
        self.mixture = plain(residual.float(), seen[valid])
        self.validity: MLPClassifier | None = None
        if not bool(valid.all()):
            # A prior of weights of one keeps the edge soft where few rows are invalid.
            how = {"solver": "lbfgs", "alpha": 1.0, "max_iter": 300, "random_state": 0}
            network = MLPClassifier((width,), "tanh", **how)
            with warnings.catch_warnings():  # of iterations that end it
                warnings.simplefilter("ignore")
                self.validity = network.fit(seen.cpu().numpy(), valid.cpu().numpy())
        self._log_unseen = -math.log(len(x) + 2)
        self.is_gaussian = nn.Buffer(torch.tensor(False))

    @property
    @override
    def embedding_net(self) -> nn.Module:
        return nn.Identity()

    def prepare(self, condition: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return rows for :meth:`prepared_loss`: all that no weight changes."""
        valid = x.isfinite().all(-1, keepdim=True)
        with torch.no_grad():
            known = torch.where(valid, x.double(), self.y_mean)
            z = self._standardize(known, condition)[0].float()
            prepared, inputs = self.mixture.prepare(z, self._see(condition))
            return torch.cat([prepared, log_normal(z)[:, None], valid], 1), inputs

    def prepared_loss(self, prepared: Tensor, inputs: Tensor) -> Tensor:
        """Return -log q of a measurement but for a constant, 0 without, shape (n,)."""
        log_density, _, valid = self._densities(prepared, inputs)
        return -torch.where(valid, log_density, 0.0)

    def choose(self, prepared: Tensor, inputs: Tensor) -> None:
        """Take the standard normal density unless the mixture does better held out."""
        with torch.no_grad():
            log_density, log_plain, valid = self._densities(prepared, inputs)
        if self.response is not None and bool(valid.any()):
            gain = (log_density - log_plain)[valid].double()
            self.is_gaussian.fill_(not exceeds_chance(gain))

    def _densities(
        self, prepared: Tensor, inputs: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return log densities of residuals, those of a normal, and whether valid."""
        prepared, log_plain, valid = prepared.tensor_split([-2, -1], 1)
        loss = self.mixture.prepared_loss(prepared, inputs)
        return -loss, log_plain[:, 0], valid[:, 0] > 0

    def loss(self, input: Tensor, condition: Tensor, **kwargs: object) -> Tensor:
        """Return -log q, shape (n,), for rows (n, x_dim) and (n, condition_dim)."""
        return -self._log_density(input[None], condition)[0]

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: object) -> Tensor:
        """Return log q(input | condition), shape (sample_dim, batch_dim), float32.

        Args:
            input: Outcomes, shape (sample_dim, batch_dim, x_dim) or (batch_dim, x_dim).
            condition: Conditions, shape (batch_dim, condition_dim), or with the
                sample_dim too.
            kwargs: Arguments that are not used.
        """
        return log_prob_of_batch(self, self._log_density, input, condition)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: object
    ) -> Tensor:
        """Return draws, shape (*sample_shape, batch_dim, x_dim)."""
        self._check_condition_shape(condition)
        shape = torch.Size(sample_shape)
        seen = self._see(condition)
        if bool(self.is_gaussian):
            z = torch.randn(*shape, len(seen), *self.input_shape, device=seen.device)
        else:
            z = self.mixture.sample(shape, seen)
        mean, whitener = self._location_and_whitener(condition)
        step = torch.linalg.solve_triangular(
            whitener, z.double()[..., None], upper=False
        )
        x = (self.y_mean + self.y_scale * (mean + step[..., 0])).float()
        if self.validity is not None:
            probability = self._log_shares(seen)[1].exp().expand(x.shape[:-1])
            x[torch.rand(probability.shape) > probability] = torch.nan
        return x

    def _log_density(self, x: Tensor, condition: Tensor) -> Tensor:
        """Return log q, (s, n, x_dim) and (n, c) -> (s, n)."""
        valid = x.isfinite().all(-1)
        known = torch.where(valid[..., None], x.double(), self.y_mean)
        z, log_det = self._standardize(known, condition)
        z, seen = z.to(torch.float32), self._see(condition)
        is_normal = bool(self.is_gaussian)
        log_density = log_normal(z) if is_normal else self.mixture.log_prob(z, seen)
        log_density = log_density + log_det.to(log_density)
        log_invalid, log_valid = self._log_shares(seen)
        return torch.where(valid, log_valid + log_density, log_invalid)

    def _log_shares(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return log probabilities of no measurement and of one, each (n,)."""
        if self.validity is None:
            # No row lacked a measurement: that it is rare says nothing of where.
            none = seen.new_zeros(len(seen))
            return none + self._log_unseen, none
        shares = self.validity.predict_log_proba(seen.detach().cpu().numpy())
        shares = torch.from_numpy(shares).to(seen).clamp_min(-100.0)  # not -inf
        return shares[:, 0], shares[:, 1]

    def _standardize(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Return residuals (..., n, x_dim) and log |dz / dx| (n,)."""
        mean, whitener = self._location_and_whitener(condition)
        y = (x - self.y_mean) / self.y_scale
        z = (whitener @ (y - mean)[..., None])[..., 0]
        log_det = whitener.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return z, log_det - self.y_scale.log().sum()

    def _location_and_whitener(self, condition: Tensor) -> tuple[Tensor, Tensor]:
        theta, action = condition.double().tensor_split([self._theta_dim], 1)
        if self.response is not None:
            return self.response.mean_and_whitener(self.whiten(theta), action)
        mean = theta.new_zeros(len(theta), len(self.y_mean))
        return mean, torch.ones_like(mean).diag_embed()

    def _see(self, condition: Tensor) -> Tensor:
        """Return whitened parameters and the action, shape (n, c), float32."""
        theta, action = condition.double().tensor_split([self._theta_dim], 1)
        return torch.cat([self.whiten(theta), action], 1).float()
