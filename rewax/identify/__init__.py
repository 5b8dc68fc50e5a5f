"""Identification: from what a camera saw to the parameters of an environment, with their uncertainty."""

from rewax.identify.adam import Minimum, minimize
from rewax.identify.body import with_body
from rewax.identify.fit import identify
from rewax.identify.losses import (
    chamfer,
    depth_picture,
    huber,
    matched,
    occupancy,
    one_sided_chamfer,
    over_time,
)
from rewax.identify.readers import read_folder
from rewax.identify.record_checks import check_record
from rewax.identify.recording import record, record_states
from rewax.identify.records import Record, load, save
from rewax.identify.resolution import with_cells
from rewax.identify.result import Identified, SavedResult, load_result
from rewax.identify.sinkhorn import sinkhorn_divergence
from rewax.identify.surface import surface_offsets, surface_residuals

__all__ = [
    "Identified", "Minimum", "Record", "SavedResult", "chamfer", "check_record", "depth_picture", "huber", "identify",
    "load", "load_result", "matched", "minimize", "occupancy", "one_sided_chamfer", "over_time", "read_folder",
    "record", "record_states", "save", "sinkhorn_divergence", "surface_offsets", "surface_residuals", "with_body",
    "with_cells",
]  # fmt: skip
