"""Show splats: the page, its server, and descriptions of files."""
