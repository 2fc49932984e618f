"""The residual of a set over the picture, before and after an effect is added.

    python -m benchmarks pouring.loop.picture --bank FOLDER --case 2 docs/pouring
    python -m benchmarks pouring.loop.picture --bank FOLDER --kind material docs/pouring

The loop compares few numbers; here the simulator itself pours draws of the posterior of
the bare model, and of the verdict's, and the mean picture is taken off that of the set,
in units of the chaos of both, in squares of 1 cm.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.loop.run import (
    FIRST,
    KINDS,
    WORLD_OF,
    criticized,
    pour_set,
    poured,
)
from benchmarks.pouring.loop.worlds import get_world
from sbi_active.display.figures import save
from sbi_active.seeding import derive_seed

NUM_POURS = 12
BLOCK = 5  # pixels, 1 cm
FLOOR = 0.05  # mm, of the deviation of a square's mean height


def blocks(images: Tensor) -> np.ndarray:
    """Return mean heights of squares of 1 cm, (n, 22500) -> (n, 30, 30)."""
    side = 150 // BLOCK
    x = images.reshape(-1, side, BLOCK, side, BLOCK).mean((2, 4))
    return x.double().numpy()


def standardized(real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Return the difference of means over its deviation, (n, ..), (m, ..) -> (..)."""
    variance = simulated.var(0, ddof=1) + FLOOR**2
    spread = np.sqrt(variance * (1 / len(real) + 1 / len(simulated)))
    return (real.mean(0) - simulated.mean(0)) / spread


def simulated_images(
    kind: str, case: int, number: int, evidence: Any, names: tuple[str, ...]
) -> Tensor:
    """Return pours of posterior draws of a model at an action, shape (12, 22500)."""
    world = get_world(WORLD_OF[kind])
    pick = np.random.default_rng(case).choice(len(evidence.draws), NUM_POURS)
    dim = len(world.task.pours.parameter_names)
    found = []
    for k, draw in enumerate(np.asarray(evidence.draws)[pick]):
        theta = torch.from_numpy(draw[:dim]).float().clamp(0, 1)
        seed = torch.tensor([derive_seed(FIRST[kind] + case, "picture", k)])
        effects = dict(zip(names, draw[dim:].tolist(), strict=True))
        action = world.actions[number][None]
        found.append(poured(world, theta, action, seed, effects)[0])
    return torch.stack(found)


def residual_figure(bank: Path, kind: str, case: int, number: int) -> Any:
    """Return the picture of a set at an action, and what models leave of it."""
    from matplotlib.figure import Figure

    criticism, report, truth = criticized(bank, kind, case)
    tracing = criticism.trace()
    action, images, _, _ = pour_set(kind, case)
    here = (action == get_world(WORLD_OF[kind]).actions[number]).all(1)
    real = blocks(images[here])
    chosen = tuple(tracing.chosen)
    models: list[tuple[str, str, tuple[str, ...]]] = [("bare model", "none", ())]
    if chosen:
        models.append(("verdict's effects", " + ".join(chosen), chosen))
    panels = [[("of the set", real.mean(0)), None]]
    for title, name, effects in models:
        evidence = tracing.evidences[name]
        x = blocks(simulated_images(kind, case, number, evidence, effects))
        residual = standardized(real, x)
        panels.append([(title, x.mean(0)), (f"residual, {title}", residual)])
    top = max(float(above[1].max()) for above, _ in panels)  # type: ignore[index]
    figure = Figure(figsize=(3.1 * len(panels), 5.8), layout="constrained")
    axes = figure.subplots(2, len(panels), squeeze=False)
    for column, pair in zip(axes.T, panels, strict=True):
        for own, panel, is_height in zip(column, pair, (True, False), strict=True):
            if panel is None:
                own.set_visible(False)
                continue
            scale: dict[str, Any] = {"vmin": -6, "vmax": 6, "cmap": "RdBu_r"}
            if is_height:
                scale = {"vmin": 0, "vmax": top, "cmap": "viridis"}
            drawn = own.imshow(panel[1], extent=(-15, 15, 15, -15), **scale)
            own.set_title(panel[0], fontsize=9)
            own.set_xlabel("y [cm]", fontsize=8)
            own.tick_params(labelsize=7)
            bar = figure.colorbar(drawn, ax=own, shrink=0.8)
            bar.set_label("mean height [mm]" if is_height else "sd of the chaos")
    axes[0, 0].set_ylabel("x [cm]", fontsize=8)
    strength = f" {float(truth['phi']):.3g}" if kind == "hidden" else ""
    figure.suptitle(f"{truth['truth']}{strength}: verdict {report.verdict}", fontsize=9)
    return figure


def main(
    folder: Path,
    *,
    bank: Path,
    kind: Annotated[str, KINDS] = "hidden",
    case: int = 0,
    action: int = 0,
) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        folder: Folder to write to.
        bank: Folder of pours.
        kind: Kind of cases.
        case: Number of the case.
        action: Number of the action, of the world's.
    """
    figure = residual_figure(bank, kind, case, action)
    save(figure, str(folder / f"residual_{kind}.png"))
