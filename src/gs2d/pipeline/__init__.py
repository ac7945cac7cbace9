"""Runs from photographs to the report: prepare, train, finish, look. Nothing here prints."""
