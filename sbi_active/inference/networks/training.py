"""Training of the mixture density network: a budget of steps on rows in memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer

from sbi_active.inference.networks.mixture_network import (
    MixtureDensityNetwork,
    PreparedLoss,
)


@dataclass(frozen=True, kw_only=True)
class TrainingBudget:
    """Length and settings of the training.

    Attributes:
        num_iterations: Steps of gradient descent.
        batch_size: Rows a step.
        clip_max_norm: Bound of the gradient's norm; None does not clip.
        anneal: Whether the learning rate falls to zero along a cosine.
        patience: Epochs without improvement on held-out rows after which training
            stops and the best weights return; None spends the whole budget.
    """

    num_iterations: int
    batch_size: int
    clip_max_norm: float | None = 5.0
    anneal: bool = False
    patience: int | None = None


@dataclass
class TrainingRecord:
    """Losses and durations, one an epoch."""

    training_loss: list[float] = field(default_factory=list)
    validation_loss: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def train_mixture_density(
    network: MixtureDensityNetwork,
    optimizer: Optimizer,
    theta: Tensor,
    condition: Tensor,
    *,
    train_rows: Tensor,
    held_out_rows: Tensor,
    budget: TrainingBudget,
    calibration_kernel: Callable[[Tensor], Tensor] | None = None,
) -> TrainingRecord:
    r"""Minimize :math:`-\sum_n K(c_n) \log q(\theta_n | c_n)` over the training rows.

    sbi's loop passes every row through a DataLoader, which costs more than the network;
    this one indexes tensors. Rows go through a network's conditioning once, and such a
    network ends with its best weights on the held-out rows.

    Args:
        network: Network that is changed in place.
        optimizer: Optimizer of the network's parameters.
        theta: Parameters, shape (n, theta_dim).
        condition: Conditions, shape (n, condition_dim).
        train_rows: Indices of rows to train on.
        held_out_rows: Indices of rows to validate on; may be empty.
        budget: Budget of the training.
        calibration_kernel: Weight K of a row; None is 1.

    Returns:
        The losses.

    Raises:
        RuntimeError: If the loss is not finite.
    """
    trained: MixtureDensityNetwork | PreparedLoss = network
    patience = budget.patience
    if network.conditioning is not None and patience is None:
        patience = budget.num_iterations  # never runs out
    if network.can_prepare and calibration_kernel is None:
        theta, condition = network.prepare(theta, condition)
        trained = PreparedLoss(network)

    def loss_of(theta: Tensor, condition: Tensor) -> Tensor:
        loss = trained.loss(theta, condition)
        if calibration_kernel is not None:
            loss = calibration_kernel(condition) * loss
        return loss.mean()

    for group in optimizer.param_groups:  # resumed: an annealed rate starts again
        group["lr"] = group.get("initial_lr", group["lr"])
    # Listed once: a walk through all modules costs a sixth of a step.
    weights = [*network.parameters()]
    size = min(budget.batch_size, len(train_rows))
    steps_an_epoch = len(train_rows) // size
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, budget.num_iterations
    )
    record, best, best_state, fruitless, done = TrainingRecord(), torch.inf, None, 0, 0
    while done < budget.num_iterations and fruitless != patience:
        start, total = time.time(), theta.new_zeros(())
        network.train()
        num_steps = min(steps_an_epoch, budget.num_iterations - done)
        order = train_rows[torch.randperm(len(train_rows))][: num_steps * size]
        # One gather an epoch: indexing rows at every step costs a tenth of the step.
        batches = zip(
            theta[order].split(size), condition[order].split(size), strict=True
        )
        for batch in batches:
            for weight in weights:
                weight.grad = None
            loss = loss_of(*batch)
            loss.backward()
            if budget.clip_max_norm is not None:
                clip_grad_norm_(weights, budget.clip_max_norm)
            optimizer.step()
            if budget.anneal:
                schedule.step()
            total += loss.detach()
        done += num_steps

        network.eval()
        training_loss = validation_loss = float(total) / num_steps
        if len(held_out_rows):
            with torch.no_grad():
                held_out = theta[held_out_rows], condition[held_out_rows]
                validation_loss = float(loss_of(*held_out))
        if not abs(validation_loss) < torch.inf:
            raise RuntimeError(
                f"expected a finite loss; got {validation_loss} after {done} "
                "iterations; lower learning_rate, or look for numbers in x far "
                "from all others"
            )
        if validation_loss < best:
            best, fruitless = validation_loss, 0
            if patience is not None:
                best_state = deepcopy(network.state_dict())
        else:
            fruitless += 1
        record.training_loss.append(training_loss)
        record.validation_loss.append(validation_loss)
        record.seconds.append(time.time() - start)
    if best_state is not None:
        network.load_state_dict(best_state)
    network.zero_grad(set_to_none=True)
    return record
