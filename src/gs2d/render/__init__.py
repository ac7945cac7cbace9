"""Rasterizers: one contract, several backends."""
