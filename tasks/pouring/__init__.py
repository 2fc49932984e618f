"""Particles poured from a bucket: an image, whose summary is part of the action."""

from sbi_active.tasks.pouring.model import Pours, images_of
from sbi_active.tasks.pouring.real import PouringRealTask, intersection_volume
from sbi_active.tasks.pouring.render import render
from sbi_active.tasks.pouring.summaries import ImagePCA, mesh_coverage
from sbi_active.tasks.pouring.task import PouringTask

__all__ = [
    "ImagePCA",
    "PouringRealTask",
    "PouringTask",
    "Pours",
    "images_of",
    "intersection_volume",
    "mesh_coverage",
    "render",
]
