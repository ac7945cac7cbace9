"""The terms of the training loss, their references in torch, and what they are made of."""
