"""Identification of a plant: fly an excitation on it, fit the minimal model, say what is left."""

from flytrack_sysid.collect import Excitation, collect
from flytrack_sysid.fit import Fit, FitError, fit
from flytrack_sysid.validate import Validation, validate

__all__ = ["Excitation", "Fit", "FitError", "Validation", "collect", "fit", "validate"]
