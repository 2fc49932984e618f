"""Sizes with which a campaign's round takes a fraction of a second."""

from sbi_active import RefinementOptions

#: Two stages: parameters of one mode need no more, and each samples and fits again.
REFINEMENT = RefinementOptions(
    num_histories=300, num_particles=1_000, first_share=0.5, stage_share=0.5
)
