"""Folders of maps, and many fields of many sizes: planned, claimed, read, integrated in lots and written whole."""

from torchdls.batch.claims import Claims
from torchdls.batch.many import Integrated, integrate_many
from torchdls.batch.maps import Manner, Map, Source, folder_source, read_map, write_map
from torchdls.batch.plan import Job, find_maps, listed_maps, plan
from torchdls.batch.report import Progress, Report
from torchdls.batch.run import LARGE, Run, Setting

__all__ = [
    "LARGE",
    "Claims",
    "Integrated",
    "Job",
    "Manner",
    "Map",
    "Progress",
    "Report",
    "Run",
    "Setting",
    "Source",
    "find_maps",
    "folder_source",
    "integrate_many",
    "listed_maps",
    "plan",
    "read_map",
    "write_map",
]
