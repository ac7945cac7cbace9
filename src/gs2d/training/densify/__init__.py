"""How splats come and go while a stage trains: one file for each way."""
