"""Look a simulator over before a campaign spends hours on it."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.actions.discrete import Actions, action_space
from sbi_active.identifiability.sensitivities import ProbeSettings
from sbi_active.identifiability.undetermined import Undetermined, find_undetermined
from sbi_active.renamed import takes_loose
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.simulation.model import SimulatorModel, takes_seeds
from sbi_active.simulation.outcomes import MissingRowsWarning, Outcome, SimulationError
from sbi_active.simulation.report import SimulatorReport
from sbi_active.simulation.simulator import outcome_tensor, require_noise
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers

MIN_ROWS = 16  # a choice: of the first runs, which are timed
RUNS = 6  # of all rows, beside one a parameter and one an entry of the action
ROUNDING = 1e-5  # relative difference between batches that mixes no rows
MANY = 0.5  # share of rows without a measurement that is worth a word


@takes_loose(workers=Workers)
def check_simulator(
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: Actions,
    *,
    num_rows: int = 256,
    max_seconds: float = 60.0,
    num_simulations: int | None = None,
    workers: Workers | int | None = None,
    seed: int = 0,
) -> SimulatorReport:
    """Run a simulator over draws of the prior and report its defects before a campaign.

    A defect keeps a campaign from working: the simulator raises, gives rows of another
    number or shape, is deterministic, has no measurement at all, mixes its rows, or
    depends on no parameter. Everything else is a warning, such as parameters that no
    permitted action tells apart, see :func:`.find_undetermined`.

    Args:
        simulator: ``simulator(theta, action)``, see
            :class:`.Simulator`.
        prior: Prior of the parameters.
        actions: Actions that the robot may take; the values of a discrete space are all
            run.
        num_rows: Rows a check, at least 16.
        max_seconds: Seconds of simulation time; a slow simulator gets fewer rows, 16 at
            least.
        num_simulations: Simulations that the campaign needs, for
            :attr:`SimulatorReport.minutes`.
        workers: Workers of the campaign, or the number of calls at a time.
        seed: Seed of the draws.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import DiscreteActions
        >>> report = check_simulator(
        ...     lambda theta, action: theta[:, :1] * action,
        ...     BoxUniform(torch.zeros(2), torch.ones(2)), DiscreteActions([1.0, 2.0]),
        ... )
        >>> report.is_ready, report.is_deterministic, report.idle_parameters
        (False, True, ('theta_2',))
    """
    run = _Runs(simulator, prior, action_space(actions), seed)
    theta, action = run.draw(MIN_ROWS)
    report = SimulatorReport(
        takes_seeds=takes_seeds(simulator),
        num_simulations=num_simulations,
        num_workers=Workers.of(workers).num_workers,
    )
    try:
        report = _look(run, theta, action, report)
    except Exception as error:  # whatever the user's code raises is the finding
        try:
            report = _look_by_rows(run, theta, action, report)
        except (SimulationError, ValueError):
            return replace(report, defects=(_told(error),))
    if report.defects:
        return report
    assert report.seconds_batch is not None
    num_runs = RUNS + 3 * theta.shape[1] + action.shape[1] + RUNS
    affordable = max_seconds / num_runs / (report.seconds_batch / MIN_ROWS + 1e-9)
    report = replace(report, num_rows=max(MIN_ROWS, min(num_rows, int(affordable))))
    theta, action = run.draw(report.num_rows)
    try:
        return _compare(run, theta, action, report)
    except SimulationError as error:
        return replace(report, defects=(_told(error),))


class _Runs:
    """Draws and runs that share their seeds."""

    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: ActionSpace,
        seed: int,
    ) -> None:
        self.simulator, self.prior = simulator, prior
        self.actions, self.seed = actions, seed

    def draw(self, num: int, key: str = "draw") -> tuple[Tensor, Tensor]:
        """Return parameters and actions; those of a discrete space equally often."""
        with forked_generators(self.seed, key, "theta"):
            theta = self.prior.sample((num,)).float()
        values = getattr(self.actions, "values", None)
        if values is None:
            seed = derive_seed(self.seed, key, "action")
            return theta, self.actions.sample((num,), seed=seed)
        with forked_generators(self.seed, key, "action"):
            order = torch.randperm(len(values))
        return theta, values[order[torch.arange(num) % len(values)]]

    def call(self, theta: Tensor, action: Tensor, seeds: Tensor) -> Any:
        """Call the simulator as it is, whatever it returns."""
        is_model = isinstance(self.simulator, SimulatorModel)
        takes = is_model or takes_seeds(self.simulator)
        given = {"seeds": seeds.clone()} if takes else {}
        with forked_generators(self.seed, "call"):
            return self.simulator(theta.clone(), action.clone(), **given)

    def simulate(self, theta: Tensor, action: Tensor, key: str = "x") -> Any:
        """Return simulations, what raises being missing."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)
            seed = derive_seed(self.seed, key)
            return simulate(self.simulator, theta, action, seed=seed)


def _look(
    run: _Runs, theta: Tensor, action: Tensor, report: SimulatorReport
) -> SimulatorReport:
    """Call it with several rows and with one; raises what it raises."""
    seeds = row_seeds(run.seed, len(theta))
    outcome_tensor(run.call(theta, action, seeds), len(theta))  # the first may load
    start = time.perf_counter()
    raw = run.call(theta, action, seeds)
    middle = time.perf_counter()
    single = outcome_tensor(run.call(theta[:1], action[:1], seeds[:1]), 1)
    end = time.perf_counter()
    x = outcome_tensor(raw, len(theta))
    if single.shape[1:] != x.shape[1:]:
        text = (
            f"expected x of one shape; got {tuple(x.shape[1:])} a row from "
            f"{len(theta)} rows and {tuple(single.shape[1:])} from one; keep the "
            "rows' axis for a single row"
        )
        return replace(report, defects=(text,))
    dtype = str(getattr(raw, "dtype", type(raw).__name__))
    output = dtype if isinstance(raw, Tensor) else f"{type(raw).__module__}.{dtype}"
    return replace(
        report,
        num_rows=len(theta),
        x_shape=tuple(x.shape[1:]),
        output=output,
        seconds_batch=middle - start,
        seconds_row=end - middle,
    )


def _look_by_rows(
    run: _Runs, theta: Tensor, action: Tensor, report: SimulatorReport
) -> SimulatorReport:
    """Simulate so that only the rows are lost that raise; raises where all do."""
    start = time.perf_counter()
    x = run.simulate(theta, action).x
    seconds = time.perf_counter() - start
    return replace(
        report,
        num_rows=len(theta),
        x_shape=tuple(x.shape[1:]),
        output=f"{x.dtype} after conversion",
        seconds_batch=seconds,
        seconds_row=seconds / len(theta),
    )


def _told(error: Exception) -> str:
    text = str(error)
    return text if text.startswith("expected ") else f"{type(error).__name__}: {text}"


def _compare(
    run: _Runs, theta: Tensor, action: Tensor, report: SimulatorReport
) -> SimulatorReport:
    """Run all rows under the same and other seeds, parameters and actions."""
    seeds = row_seeds(derive_seed(run.seed, "x"), len(theta))
    start = time.perf_counter()
    rows = run.simulate(theta, action)
    seconds = time.perf_counter() - start
    again, other = run.simulate(theta, action), run.simulate(theta, action, "other")
    reproducible = _same(rows.x, again.x)
    independent = None
    if report.takes_seeds and rows.counts["missing"] == 0:
        order = torch.arange(len(theta)).flip(0)
        x = outcome_tensor(run.call(theta, action, seeds), len(theta))
        permuted = run.call(theta[order], action[order], seeds[order])
        permuted = outcome_tensor(permuted, len(theta))
        independent = _close(permuted, x[order])
    report = replace(
        report,
        seconds_batch=seconds,
        counts=rows.counts,
        lost_by_action=_lost(action, rows.status != Outcome.OK),
        is_reproducible=reproducible,
        is_deterministic=_identical(rows.x, other.x),
        noiseless=_noiseless(rows.x, other.x),
        rows_are_independent=independent,
    )
    if reproducible:
        fresh = run.draw(len(theta), "fresh")
        report = replace(
            report,
            idle_parameters=_idle(run, rows.x, (theta, action), 0, fresh[0]),
            idle_actions=_idle(run, rows.x, (theta, action), 1, fresh[1]),
        )
        report = replace(
            report, undetermined=_undetermined(run, theta.shape[1], report)
        )
    return _judge(run, report, theta, action, rows)


def _idle(
    run: _Runs, x: Tensor, drawn: tuple[Tensor, Tensor], which: int, fresh: Tensor
) -> tuple[str, ...]:
    """Return names of columns of theta (0) or action (1) that change nothing."""
    names = _names(run, which, fresh.shape[1])
    idle = []
    for column, name in enumerate(names):
        changed = list(drawn)
        changed[which] = drawn[which].clone()
        changed[which][:, column] = fresh[:, column]
        if torch.equal(changed[which], drawn[which]):  # a single action
            continue
        if _same(run.simulate(changed[0], changed[1]).x, x):
            idle.append(name)
    return tuple(idle)


def _undetermined(
    run: _Runs, num_parameters: int, report: SimulatorReport
) -> tuple[Undetermined, ...]:
    """Return parameters that no action tells apart, beside those that do nothing."""
    actions, num = run.actions.listed(), None
    if actions is None:
        seed = derive_seed(run.seed, "undetermined")
        actions = run.actions.sample((ProbeSettings().most_actions,), seed=seed)
    else:
        num = len(actions)
        with forked_generators(run.seed, "undetermined"):
            actions = actions[torch.randperm(num)]
    fewest = max(report.num_rows // 4, 1)  # as many sets of parameters as actions
    names = _names(run, 0, num_parameters)
    try:
        return find_undetermined(
            lambda theta, action, key: run.simulate(theta, action, key).x,
            run.prior,
            actions[:fewest],
            names,
            skip=[i for i, name in enumerate(names) if name in report.idle_parameters],
            num_rows=report.num_rows,
            num_numbers=math.prod(report.x_shape or (1,)),
            num_permitted=num,
            seed=run.seed,
        )
    except SimulationError:  # at parameters next to others that it could simulate
        return ()


def _names(run: _Runs, which: int, num: int) -> Sequence[str]:
    if which == 1:
        return run.actions.names
    names = getattr(run.simulator, "parameter_names", None)
    return [f"theta_{i + 1}" for i in range(num)] if names is None else names


def _judge(
    run: _Runs, report: SimulatorReport, theta: Tensor, action: Tensor, rows: Any
) -> SimulatorReport:
    """Add defects and warnings."""
    defects: list[str] = []
    notes: list[str] = []
    lost = len(theta) - report.counts["ok"]
    if lost == len(theta):
        defects.append("SA401 no row has a measurement")
    elif lost > MANY * len(theta):
        notes.append(f"SA401 {lost / len(theta):.0%} of the rows have no measurement")
    if report.counts["missing"]:
        text = next(iter(rows.tracebacks.values()), "").strip().splitlines()
        notes.append(
            f"SA301 {report.counts['missing']} rows raise, the first "
            f"{text[-1] if text else 'without a word'}; their outcome is missing; "
            "return NaN where the system gave no measurement"
        )
    if report.is_deterministic:
        try:
            require_noise(rows.x, rows.x)
        except ValueError as error:
            defects.append(str(error))
    model = run.simulator
    declared = isinstance(model, SimulatorModel) and model.noise is not None
    sound = report.counts["missing"] == 0
    if declared and sound and not model.is_deterministic(theta, action):
        notes.append(
            "SA402 fn is random beside declared noise, which so counts twice; declare "
            "noise=None, or remove the random numbers from fn"
        )
    if report.noiseless:
        notes.append(
            f"SA403 numbers {', '.join(map(str, report.noiseless))} of x have no "
            "noise, and so no density; declare the noise of every channel"
        )
    if report.rows_are_independent is False:
        defects.append(
            "SA404 rows permuted with their seeds do not give permuted x; let row i "
            "depend on theta[i], action[i] and seeds[i] alone"
        )
    if not report.is_reproducible:
        notes.append(
            "SA405 one seed gives two different x, so that no run can be repeated; "
            "take seeds, or draw from torch's or NumPy's global generator"
        )
    if len(report.idle_parameters) == theta.shape[1]:
        defects.append("SA303 no parameter changes x")
    elif idle := ", ".join(report.idle_parameters):
        notes.append(f"SA303 changing {idle} leaves x as it is")
    if idle := ", ".join(report.idle_actions):
        notes.append(f"SA303 changing {idle} leaves x as it is")
    notes += [f"SA406 {group}" for group in report.undetermined]
    return replace(report, defects=(*defects,), warnings=(*notes,))


def _lost(action: Tensor, lost: Tensor) -> tuple[tuple[tuple[float, ...], float], ...]:
    """Return the share of lost rows by action, largest first."""
    distinct, inverse = torch.unique(action, dim=0, return_inverse=True)
    if len(distinct) > len(action) / 2:  # a continuous space: too few rows an action
        return ()
    share = torch.zeros(len(distinct)).index_add_(0, inverse, lost.float())
    share /= torch.bincount(inverse)
    order = share.argsort(descending=True, stable=True)
    order = order[share[order] > 0]
    return tuple((tuple(distinct[i].tolist()), float(share[i])) for i in order)


def _same(x: Tensor, other: Tensor) -> bool:
    return bool(((x == other) | (x.isnan() & other.isnan())).all())


def _close(x: Tensor, other: Tensor) -> bool:
    measured = x[x.isfinite()]
    scale = float(measured.std()) if len(measured) > 1 else 0.0
    near = torch.isclose(x, other, rtol=ROUNDING, atol=ROUNDING * scale * 0.1)
    return bool((near | (x == other) | (x.isnan() & other.isnan())).all())


def _identical(x: Tensor, other: Tensor) -> bool:
    """Return whether all numbers that both have are equal, and there are some."""
    both = x.isfinite() & other.isfinite()
    return bool(both.any()) and bool((x[both] == other[both]).all())


def _noiseless(x: Tensor, other: Tensor) -> tuple[int, ...]:
    """Return numbers of x that the seed leaves alone while it changes others."""
    x, other = x.flatten(1), other.flatten(1)
    both = x.isfinite() & other.isfinite()
    silent = ((x == other) | ~both).all(0) & both.any(0)
    return () if bool(silent.all()) else tuple(torch.nonzero(silent)[:, 0].tolist())
