"""What is trained and how it is scored, as values: recipes, schedules, protocols. Never imports torch."""
