"""Sizes with which a campaign's round takes a fraction of a second."""

from sbi_active import RefinementOptions

REFINEMENT = RefinementOptions(num_histories=200, num_effective=25)
