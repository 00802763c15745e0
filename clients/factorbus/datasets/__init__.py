"""The public data sets: which there are, where they are found, how they are fetched, converted and checked.

`find("intel")` is what everything that takes a data set by name needs.
"""

from factorbus.datasets.catalogue import Dataset, Source, dataset_named
from factorbus.datasets.checksum import ChecksumResult, check_dataset
from factorbus.datasets.convert import convert
from factorbus.datasets.errors import DatasetProblem
from factorbus.datasets.fetch import fetch_dataset
from factorbus.datasets.known import CATALOGUE
from factorbus.datasets.places import FoundFile, Places, find, locate

__all__ = [
    "CATALOGUE",
    "ChecksumResult",
    "Dataset",
    "DatasetProblem",
    "FoundFile",
    "Places",
    "Source",
    "check_dataset",
    "convert",
    "dataset_named",
    "fetch_dataset",
    "find",
    "locate",
]
