"""The terms of the training loss, their references in torch, and their formulas."""
