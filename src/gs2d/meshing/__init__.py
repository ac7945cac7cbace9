"""Surfaces: sparse TSDF fusion and marching cubes."""
