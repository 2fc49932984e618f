"""Attacks by what a simulator returns, and by what it is given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.robustness.attacks import Attacks
from benchmarks.robustness.simulations import (
    WAYS,
    quietly,
    require,
    require_raises,
    rows_of,
    seeded,
)
from sbi_active import SimulatorModel
from sbi_active.simulation import (
    SimulationError,
    simulate,
)

ATTACKS = Attacks()

TAKEN: dict[str, Callable[[Tensor], Any]] = {
    "float64": lambda t: t.double(),
    "float16": lambda t: t.half(),
    "bfloat16": lambda t: t.bfloat16(),
    "int64": lambda t: t.long(),
    "uint8": lambda t: t.to(torch.uint8),
    "numpy float64": lambda t: t.numpy().astype(float),
    "numpy int16": lambda t: t.numpy().astype(np.int16),
    "numpy uint32": lambda t: t.numpy().astype(np.uint32),
    "numpy long double": lambda t: t.numpy().astype(np.longdouble),
    "numpy objects": lambda t: t.numpy().astype(object),
    "other bytes": lambda t: t.numpy().astype(">f8"),
    "negative strides": lambda t: t.flip(0).numpy()[::-1],
    "not writable": lambda t: np.broadcast_to(t.numpy(), t.shape),
    "columns first": lambda t: np.asfortranarray(t.numpy()),
    "a list": lambda t: t.tolist(),
    "a list of tensors": lambda t: list(t),
    "a tuple of arrays": lambda t: tuple(t.numpy()),
    "one axis": lambda t: t[:, 0],
    "three axes": lambda t: t[:, :, None],
    "with a gradient": lambda t: t * torch.ones(1, requires_grad=True),
}


@ATTACKS.add("x of another form", cases=tuple(TAKEN))
def form_of_x(form: str) -> None:
    function = TAKEN[form]
    for way in ("one call", "batches of 33"):
        rows = quietly(lambda t, a, seeds: function(t), 100, **WAYS[way])
        x = rows.x.detach().reshape(100, 1)
        assert torch.equal(x, rows_of(100)[0])
        assert rows.counts == {"ok": 100, "invalid": 0, "missing": 0}


LOST: dict[str, tuple[str, Callable[[Tensor], Any]]] = {
    "1e39": ("within +-3.4e38", lambda t: t.double() + 1e39),
    "one -1e300": ("within +-3.4e38", lambda t: t.double().where(t > 0, -1e300)),
    "1e200 of numpy": ("within +-3.4e38", lambda t: t.numpy() + np.float64(1e200)),
    "1e39 in a list": ("within +-3.4e38", lambda t: [1e39] * len(t)),
    "complex": ("real numbers", lambda t: t + 1j),
    "complex of numpy": ("real numbers", lambda t: np.fft.fft(t.numpy(), axis=0)),
    "complex in a list": ("real numbers", lambda t: [1j] * len(t)),
    "no numbers": ("at least one number", lambda t: t[:, :0]),
    "an empty axis": ("at least one number", lambda t: torch.zeros(len(t), 3, 0)),
    "empty lists": ("at least one number", lambda t: [[]] * len(t)),
    "too few rows": ("one row a parameter set", lambda t: t[:1]),
    "a single number": ("one row a parameter set", lambda t: 1.0),
    "rows transposed": ("one row a parameter set", lambda t: t.T),
}


@ATTACKS.add("x that would lose information", cases=tuple(LOST))
def lossy_x(form: str) -> None:
    text, function = LOST[form]

    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Any:
        return function(theta)

    for options in ({}, {"num_workers": 2}):
        require_raises(ValueError, text, lambda o=options: quietly(simulator, **o))
    model = SimulatorModel(lambda theta, action: function(theta))
    require_raises(ValueError, text, lambda: quietly(model))


@ATTACKS.add("a complex row", cases=(1j, "array", "tensor"))
def complex_row(case: Any) -> None:
    row = {"array": np.array([1j]), "tensor": torch.tensor([1j])}.get(case, case)
    model = SimulatorModel(lambda theta, action, rng: row, batched=False)
    require_raises(ValueError, "real numbers", lambda: quietly(model))


@ATTACKS.add("no outcome at all", cases=("rows", "batches", "some rows"))
def no_outcome(case: str) -> None:
    if case == "some rows":

        def some(theta: np.ndarray, action: np.ndarray, rng: Any) -> Any:
            return theta if theta[0] != 7 else None

        rows = quietly(SimulatorModel(some, batched=False))
        require(rows, rows_of(300)[0], missing=(7,))
        return
    model = SimulatorModel(lambda theta, action, rng: None, batched=False)
    simulator = model if case == "rows" else lambda theta, action: None
    require_raises(SimulationError, "got None", lambda: quietly(simulator))


@ATTACKS.add("masked numbers", cases=("batch", "row"))
def masked(case: str) -> None:
    def row(theta: np.ndarray, action: np.ndarray, rng: Any) -> Any:
        return np.ma.masked_array([theta[0], 1.0], [theta[0] == 3, False])

    def batch(theta: Tensor, action: Tensor) -> Any:
        x = np.stack([theta[:, 0].numpy(), np.ones(len(theta))], 1)
        return np.ma.masked_array(x, (x == 3) & [True, False])

    rows = quietly(SimulatorModel(row, batched=False) if case == "row" else batch)
    assert bool(rows.valid.all())
    assert rows.x[3].isnan().tolist() == [True, False]
    assert int(rows.x.isnan().sum()) == 1


@ATTACKS.add("NaN and infinite numbers", cases=(torch.nan, torch.inf, -torch.inf))
def lost_numbers(value: float) -> None:
    def simulator(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        x = theta.repeat(1, 2)
        x[theta[:, 0] == 3] = value
        x[theta[:, 0] == 4, 0] = value
        return x

    for options in WAYS.values():
        rows = quietly(simulator, 100, **options)
        assert rows.counts == {"ok": 99, "invalid": 1, "missing": 0}
        assert rows.x[3].isnan().all()
        assert rows.x[4].isnan().tolist() == [True, False]


@ATTACKS.add("rows of several shapes", cases=("one call", "two workers"))
def ragged(way: str) -> None:
    def row(theta: np.ndarray, action: np.ndarray, rng: Any) -> Any:
        return np.zeros(2 if theta[0] > 100 else 1)

    model = SimulatorModel(row, batched=False)
    require_raises(ValueError, "one shape", lambda: quietly(model, **WAYS[way]))


@ATTACKS.add(
    "theta or actions that are no numbers", cases=("NaN", "inf", "1e39", "complex")
)
def bad_theta(case: str) -> None:
    value = {"NaN": np.nan, "inf": np.inf, "1e39": 1e39, "complex": 1j}[case]
    text = "real numbers" if case == "complex" else "expected finite"
    good = torch.ones(4, 1)
    bad = torch.tensor([[value]] * 4).to(torch.complex128 if value == 1j else None)
    if case == "1e39":
        bad = torch.full((4, 1), 1e39, dtype=torch.float64)
    for rows in ((bad, good), (good, bad)):
        require_raises(ValueError, text, lambda r=rows: simulate(seeded, *r, seed=0))
