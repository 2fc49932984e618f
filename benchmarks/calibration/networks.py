"""Are networks flagged that are under-trained or wrong at one action, and no others?

    python -m benchmarks calibration.networks --problem numerical

Under-trained: 20 to 100 steps of the paper's network on 5,000 rows. Trained: 3,000
steps of the default one on 20,000; of location 5,000 steps of eight components on
40,000, where "trained less" is as elsewhere. Seeds from 2000 on judge.

The share of networks or beliefs that are flagged, by problem and kind.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from attrs import evolve
from torch import Tensor

from benchmarks.rows import benchmark, column, grouped
from sbi_active import ASBI, MixtureDensity
from sbi_active.diagnostics import check_calibration
from sbi_active.diagnostics.calibration import clopper_pearson
from sbi_active.inference import ActionPosterior
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.tasks import Task, get_task


def shares(rows: list[dict[str, str]]) -> str:
    """Return a line for each problem and kind."""
    lines = []
    for (problem, kind), own in grouped(rows, "problem", "kind").items():
        n, k = len(own), sum(row["verdict"] != "trust" for row in own)
        low, high = clopper_pearson(k, n, 0.05)
        line = f"{problem:12s} {kind:14s} flagged {k}/{n} ({low:.2f} to {high:.2f})"
        if kind == "one action":
            hit = [(r["wrong_flagged"] == "1", r["others_flagged"] == "0") for r in own]
            line += f", at the wrong action {sum(at for at, _ in hit)}"
            line += f", only there {sum(at and alone for at, alone in hit)}"
        lines.append(f"{line}; {column(own, 'cpu_seconds').mean():.1f} CPU s")
    return "\n".join(lines)


#: Name of a problem: task and options.
PROBLEMS: dict[str, tuple[str, dict[str, Any]]] = {
    "numerical": ("numerical", {}),
    "square": ("numerical", {"variant": "square"}),
    "location": ("location_finding", {}),
}
TRAINED = MixtureDensity(num_iterations=3_000)
#: Its posteriors are rings about a source, of which TRAINED loses two fifths.
LONGER = MixtureDensity(num_components=8, num_iterations=5_000)
NUM_TRAINED, NUM_LONGER, NUM_UNDER = 20_000, 40_000, 5_000


def train(task: Task, settings: MixtureDensity, rows: int, seed: int) -> ASBI:
    """Return a trainer after one round from the prior."""
    with forked_generators(derive_seed(seed, "train")):
        inference = ASBI(task.prior, density_estimator=settings)
        theta = task.prior.sample(torch.Size([rows]))
        action = task.actions.sample((rows,))
        x = simulate(task.simulator, theta, action, seed=derive_seed(seed, "x")).x
        inference.append_simulations(theta, x, action=action, belief=task.prior)
        inference.train()
    return inference


class WrongAt(torch.nn.Module):
    """A network whose posteriors at one action are half as wide and moved."""

    def __init__(self, network: Any, action: Tensor) -> None:
        super().__init__()
        self.network, self.action = network, action
        self.shrink, self.move = 0.5, 1.0

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("network"), name)

    def _parts(self, condition: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        dim = len(self.action)
        wrong = (condition[:, -dim:] - self.action).abs().amax(1) < 1e-4
        with forked_generators(0):
            draws = self.network.sample(torch.Size([200]), condition)
        return wrong, draws.mean(0), draws.std(0)

    def sample(self, shape: torch.Size, condition: Tensor, **_: Any) -> Tensor:
        draws = self.network.sample(shape, condition)
        wrong, center, spread = self._parts(condition)
        moved = center + self.move * spread + self.shrink * (draws - center)
        return torch.where(wrong[:, None], moved, draws)

    def log_prob(self, theta: Tensor, condition: Tensor, **_: Any) -> Tensor:
        wrong, center, spread = self._parts(condition)
        back = center + (theta - center - self.move * spread) / self.shrink
        there = self.network.log_prob(back, condition)
        there = there - theta.shape[-1] * torch.tensor(self.shrink).log()
        return torch.where(wrong, there, self.network.log_prob(theta, condition))


def network_row(problem: str, kind: str, seed: int) -> dict[str, object]:
    """Return the row of one network: "trained", "trained less" and so on."""
    begin = time.process_time()
    name, options = PROBLEMS[problem]
    task = get_task(name, **options)
    settings, rows = TRAINED, NUM_TRAINED
    if problem == "location" and kind == "trained":
        settings, rows = LONGER, NUM_LONGER
    steps = settings.num_iterations
    if kind == "under":
        steps = 20 + derive_seed(seed, "steps") % 81
        under = evolve(MixtureDensity.faithful(), num_iterations=steps)
        inference = train(task, under, NUM_UNDER, seed)
    else:
        inference = train(task, settings, rows, seed)
    wrong, posterior = None, inference.build_posterior()
    if kind == "one action":
        wrong = derive_seed(seed, "wrong") % len(task.actions)
        packed: Any = posterior.packed()
        action = task.actions.values[wrong]
        packed.posterior_estimator = WrongAt(packed.posterior_estimator, action)
        posterior = ActionPosterior(packed, posterior.x_shape, posterior.action_dim)
    size = 2_000 if kind == "one action" else 1_000
    found = check_calibration(
        posterior,
        task.simulator,
        actions=task.actions,
        num_simulations=size,
        max_strata=24 if kind == "one action" else 12,
        seed=derive_seed(seed, "check"),
    )
    flagged = [s.verdict != "trust" for s in found.strata]
    others = [f for k, f in enumerate(flagged) if k != wrong]
    return {
        "steps": steps,
        "verdict": found.verdict,
        "wrong_flagged": "" if wrong is None else int(flagged[wrong]),
        "others_flagged": "" if wrong is None else sum(others),
        "cpu_seconds": time.process_time() - begin,
        "reason": found.reasons[0] if found.reasons else "",
    }


main = benchmark(
    Path(__file__).parent / "results/networks.csv",
    network_row,
    shares,
    skip=lambda problem, kind, seed: kind == "trained less" and problem != "location",
    problem=PROBLEMS,
    kind=("under", "trained", "trained less", "one action"),
    seed=range(2_000, 2_040),
)
