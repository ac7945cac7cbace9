"""Show splats: the page for a browser, its server, and the facts of a file."""
