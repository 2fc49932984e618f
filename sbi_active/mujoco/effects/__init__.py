"""Effects that a plain MuJoCo model lacks, enumerated from the model itself.

This package makes effects of a compiled model: their names, units, null values and
priors, and what they write into it. The comparison of effects with trials is in
``sbi_active.criticism``.
"""
