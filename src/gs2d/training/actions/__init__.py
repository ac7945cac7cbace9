"""Entry actions: what runs once when a stage begins."""
