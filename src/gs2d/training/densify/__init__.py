"""Densifiers, which add and remove splats while a stage trains."""
