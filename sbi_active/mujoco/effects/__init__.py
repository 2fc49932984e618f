"""Effects that a plain MuJoCo model lacks, enumerated from the model itself.

Here lives what makes effects of a compiled model: their names, units, null values and
priors, and what they write into it. How effects are compared with trials stands in
``sbi_active.criticism``.
"""

from sbi_active.mujoco.effects.library import mjcf_effects

__all__ = ["mjcf_effects"]
