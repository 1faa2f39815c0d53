"""Identification of a plant: fly an excitation on it, fit the minimal model, say what is left."""
