"""``report.html``: sections, plots and images of a run in one file."""
