"""Readers of other programs' flight logs: CSV by a mapping file, PX4, Betaflight and others."""

from flytrack_sysid.importing.importer import FORMATS, Imported, import_log
from flytrack_sysid.importing.mapping import load_mapping

__all__ = ["FORMATS", "Imported", "import_log", "load_mapping"]
