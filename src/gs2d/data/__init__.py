"""Posed photographs: readers of every supported layout."""
