"""The campaign in ``version_1/``, written by the first release that keeps campaigns.

It is read by all later ones; nothing here may change, nor is it to be written again.
It had 100 simulations a round, of this simulator, and the trials that are told anew in
``test_versions.py``.
"""

from pathlib import Path

import torch

FOLDER = Path(__file__).parent / "version_1"


def simulator(theta, action):
    mean = theta[:, :1] * action + theta[:, 1:2] * torch.linspace(0, 1, 3)
    return mean + 0.1 * torch.randn(len(theta), 3)
