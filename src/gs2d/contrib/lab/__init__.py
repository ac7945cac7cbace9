"""Experiments: tables of many runs, blocks, clusters, official evaluations."""
