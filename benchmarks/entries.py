"""All benchmarks of the suite. Importing a module of entries registers its benchmarks."""

from __future__ import annotations

from benchmarks import entries_cost, entries_error
from benchmarks.suite import ENTRIES

MODULES = (entries_cost, entries_error)
__all__ = ["ENTRIES", "MODULES"]
